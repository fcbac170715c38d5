# SPDX-License-Identifier: Apache-2.0
"""Which frames of a film are matched: the sharpest of each stretch of it, without those that are blurred.

How sharp an image looks depends on what it shows, a bookshelf more than a wall; so a frame is judged beside
those around it, which show much the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from raytran.capture.frames import sharpness
from raytran.capture.poses.film import Film
from raytran.errors import DataError

_WIDTH = 480
"""Columns of the images whose sharpness is measured: matching needs finer detail than the network does."""

_A_STRETCH = 6
"""Frames of a stretch that are looked at."""

_BESIDE = 6
"""Stretches before and after one with which it is compared."""

_BLURRED = 0.35
"""A frame is blurred if it is less sharp than this part of the median around it. Moved by 1 % of its width
while the shutter was open, the median frame of a real scan is at 0.45 and of a generated one at 0.34, by 2 %
at 0.27 and 0.17. Of the 96 frames of that scan as they are, two are below."""

_LONGEST_GAP = 2
"""Stretches in a row that may be left out: a film that is blurred for longer is followed through the best."""


@dataclass(frozen=True)
class FrameChoice:
    """Frames of a film.

    Attributes:
        frames: numbers of those that were chosen, ascending.
        num_blurred: stretches left out because their sharpest frame is blurred.
        num_damaged: frames that could not be read.
    """

    frames: tuple[int, ...]
    num_blurred: int
    num_damaged: int


def choose_sharp(
    film: Film, count: int, *, progress: Callable[[Iterable[int], int], Iterable[int]] | None = None
) -> FrameChoice:
    """Choose up to ``count`` sharp frames, one of each of as many equal stretches of the film.

    Args:
        film: the film.
        count: number of stretches; a shorter film has a stretch for each frame.
        progress: given the frames that are looked at and how many they are, yields them again.

    Raises:
        DataError: no frame can be read.
    """
    borders = np.linspace(0, len(film), min(count, len(film)) + 1)
    stretches = [_spread(int(np.ceil(a)), int(np.ceil(b))) for a, b in pairwise(borders)]
    looked_at = [frame for stretch in stretches for frame in stretch]
    measured: dict[int, float] = {}
    for frame in looked_at if progress is None else progress(looked_at, len(looked_at)):
        try:
            measured[frame] = sharpness(_grey(film.read(frame)))
        except DataError:
            continue
    best = [
        max((f for f in stretch if f in measured), key=measured.__getitem__, default=None)
        for stretch in stretches
    ]
    frames = np.array([frame for frame in best if frame is not None], dtype=np.int64)
    if not len(frames):
        raise DataError(f"no frame of {film.path} can be read: copy or export it again")
    kept = keep_sharp(np.array([measured[int(frame)] for frame in frames]))
    return FrameChoice(tuple(frames[kept].tolist()), int((~kept).sum()), len(looked_at) - len(measured))


def keep_sharp(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which frames are kept by their sharpness, ``(n,)`` in the order of the film.

    Left out are those far less sharp than the median of the frames around them, but never more than two in a
    row: then the sharpest of each three stays, for matching must not lose its way.
    """
    around = [values[max(0, i - _BESIDE) : i + _BESIDE + 1] for i in range(len(values))]
    kept = values >= _BLURRED * np.array([np.median(part) for part in around])
    run: list[int] = []
    for i in range(len(values)):
        if kept[i]:
            run = []
            continue
        run.append(i)
        if len(run) > _LONGEST_GAP:
            stays = max(run, key=values.__getitem__)
            kept[stays] = True
            run = [j for j in run if j > stays]
    return kept


def _spread(start: int, stop: int) -> list[int]:
    """Return up to ``_A_STRETCH`` frames of a stretch, spread evenly."""
    count = min(stop - start, _A_STRETCH)
    return np.unique(np.linspace(start, stop - 1, count).round().astype(int)).tolist() if count else []


def _grey(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    image = Image.fromarray(pixels).convert("L")
    if image.width > _WIDTH:
        image = image.resize(
            (_WIDTH, max(1, round(image.height * _WIDTH / image.width))), Image.Resampling.BILINEAR
        )
    return np.asarray(image, dtype=np.float32) / np.float32(255)
