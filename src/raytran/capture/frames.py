# SPDX-License-Identifier: Apache-2.0
"""The frames of a scan as stored: small grey images, depth maps, cameras, and which images are blurred."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from raytran.data.images import UNREADABLE, open_image
from raytran.data.scan import OpenScan
from raytran.data.scannet.scan import Scan, SensScan
from raytran.errors import DataError
from raytran.limits import MAX_SIDE

_DEPTH_STEPS = 1000.0
"""Steps of ScanNet's exported depth maps in a metre."""

_DEPTH_KINDS = ("PNG", "PPM")

_BLUR_WIDTH = 240
"""Columns of the images whose sharpness is measured: a network whose cells are 16 pixels wide sees no finer
detail."""

_BLURRED = 0.25
"""A frame is blurred if it is less sharp than this part of the scan's median. In two real scans no frame is;
moved by 4 % of its width while the shutter was open, the median frame is at 0.2."""


@dataclass(frozen=True)
class RawScan:
    """A scan whose cameras may be wrong: nothing is corrected or left out that could show a fault.

    Attributes:
        scan: the open scan, which must stay open.
        stored: ``(n, 4, 4)`` float64, the matrices of the pose files.
        intrinsics: ``(n, 3, 3)`` float64, as stored.
        axis_alignment: ``(4, 4)`` float64, aligned_from_world; identity if the scan has none.
    """

    scan: OpenScan
    stored: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    axis_alignment: NDArray[np.float64]

    @staticmethod
    def of(scan: OpenScan) -> RawScan:
        """Return an open scan with its cameras as arrays."""
        return RawScan(
            scan,
            scan.world_from_camera.double().numpy(),
            scan.intrinsics.double().numpy(),
            scan.axis_alignment.double().numpy(),
        )

    def __len__(self) -> int:
        return len(self.scan)

    def read_depth(self, frame: int) -> NDArray[np.float64] | None:
        """Return a frame's depth map, metres, 0 where unknown; None if it has none or a damaged one."""
        try:
            if isinstance(self.scan, SensScan):
                steps = self.scan.file.read_depth(self.scan.file_index[frame])
                return None if steps is None else steps / float(self.scan.file.depth_shift)
            path = _depth_path(self.scan, frame)
            if path is None:
                return None
            with open_image(path, kinds=_DEPTH_KINDS) as image:
                if max(image.size) > MAX_SIDE:
                    return None
                depth = np.asarray(image, dtype=np.float64) / _DEPTH_STEPS
            return depth if depth.ndim == 2 else None
        except (DataError, *UNREADABLE):
            return None

    def frames_with_depth(self) -> list[int]:
        """Return the frames that have a depth map."""
        if isinstance(self.scan, SensScan):
            return list(range(len(self)))
        return [i for i in range(len(self)) if _depth_path(self.scan, i) is not None]

    def unreadable_images(self, *, max_images: int) -> tuple[int, list[str]]:
        """Decode up to ``max_images`` images, spread evenly; return how many, and a sentence a failure."""
        count = min(max_images, len(self))
        frames = np.unique(np.linspace(0, len(self) - 1, count).round().astype(int)).tolist()
        failures = []
        for frame in frames:
            try:
                self.scan.read_color(frame)
            except DataError as error:
                failures.append(str(error))
        return len(frames), failures


def read_grey(scan: OpenScan, frame: int, width: int) -> tuple[NDArray[np.float32], float]:
    """Return a frame in grey, at most ``width`` columns wide, and its size relative to the stored one.

    Returns:
        ``(h, w)`` in [0, 1], black if the image cannot be read (the doctor names it); and ``w / W``.
    """
    height, stored_width = scan.image_size
    factor = min(1.0, width / stored_width)
    size = (round(height * factor), round(stored_width * factor))
    try:
        color = Image.fromarray(scan.read_color(frame, size))
    except DataError:
        return np.zeros(size, dtype=np.float32), factor
    return np.asarray(color.convert("L"), dtype=np.float32) / np.float32(255), factor


def sharpness(grey: NDArray[np.float32]) -> float:
    """Return the variance of the Laplacian (Pech-Pacheco et al. 2000) of an image ``(H, W)`` in [0, 1]."""
    return float(ndimage.laplace(grey).var())


def blurred_frames(scan: OpenScan, frames: Sequence[int]) -> NDArray[np.bool_]:
    """Return which of some frames are blurred or cannot be read, ``(len(frames),)``; fewer than half are.

    Args:
        scan: an open scan.
        frames: positions in it, best ascending: videos are read from front to back.
    """
    if not len(frames):
        return np.zeros(0, dtype=np.bool_)
    values = np.array(
        [sharpness(_shown(scan, frame, *read_grey(scan, frame, _BLUR_WIDTH))) for frame in frames]
    )
    return values < _BLURRED * np.median(values)


def _shown(scan: OpenScan, frame: int, grey: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """Return the part of a grey image that a frame shows, without what fills it up."""
    if scan.picture is None:
        return grey
    left, top, right, bottom = (scan.picture[frame] * factor).round().long().tolist()
    return grey[top:bottom, left:right]


def _depth_path(scan: OpenScan, frame: int) -> Path | None:
    """Return the depth map beside a frame's image, as ScanNet's two exporters write it."""
    if not isinstance(scan, Scan):
        return None
    image, name = scan.image_path[frame], scan.frame_id[frame]
    candidates = (
        image.parent.parent / "depth" / f"{name}.png",
        image.with_name(image.name.replace(".color.", ".depth.")).with_suffix(".pgm"),
    )
    return next((path for path in candidates if path != image and path.is_file()), None)
