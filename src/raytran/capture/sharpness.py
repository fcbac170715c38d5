# SPDX-License-Identifier: Apache-2.0
"""Which frames of a scan are blurred, from small copies of its images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from raytran.capture.doctor.recording import Recording
from raytran.data.scan import OpenScan

WIDTH = 240
"""Columns of the copies: finer detail is lost on a network whose cells are 16 pixels wide."""

BLURRED = 0.25
"""A frame is blurred if it is less sharp than this part of the scan's median. In two real scans no frame is;
moved by 4 % of its width while the shutter was open, the median frame is at 0.2."""


def sharpness(grey: NDArray[np.float32]) -> float:
    """Return the variance of the Laplacian (Pech-Pacheco et al. 2000) of an image ``(H, W)`` in [0, 1]."""
    return float(ndimage.laplace(grey).var())


def blurred_frames(scan: OpenScan, frames: Sequence[int]) -> NDArray[np.bool_]:
    """Return which of some frames are blurred or cannot be read, ``(len(frames),)``; fewer than half are.

    Args:
        scan: an open scan.
        frames: positions in it, best ascending: videos are read from front to back.
    """
    recording = Recording.of(scan)
    found = np.array([sharpness(recording.read_grey(frame, WIDTH)[0]) for frame in frames])
    return found < BLURRED * np.median(found) if len(found) else np.zeros(0, dtype=np.bool_)
