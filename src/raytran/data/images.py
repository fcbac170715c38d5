# SPDX-License-Identifier: Apache-2.0
"""Reads and resizes the images of a scan, some of which may be damaged."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from raytran.errors import DataError
from raytran.limits import MAX_SIDE

_log = logging.getLogger(__name__)

MIN_VIEWS = 2
"""Fewest different frames from which a scene is reconstructed."""

FILL = (124, 116, 104)
"""Red, green and blue around a picture of another shape: ImageNet's mean, which encoders take for zero."""

_SAME_ASPECT = 0.01
"""Relative difference up to which two images have the same aspect: one row or column of a hundred."""

_ROUNDING = 1e-6

_UNREADABLE = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)
"""What Pillow raises for files that are truncated, damaged, absurdly large or no images."""


def decode_image(
    image: Path | bytes,
    *,
    name: str,
    image_size: tuple[int, int] | None = None,
    stored: tuple[int, int] | None = None,
) -> Tensor:
    """Read an image that lies in a file of its own or in memory.

    Args:
        image: path or content of a JPEG or PNG file.
        name: what to call it in errors.
        image_size: ``(H, W)`` wanted, or None to keep its size.
        stored: ``(H, W)`` that the image must have, or None for any.

    Returns:
        ``(3, H, W)`` uint8 RGB, a view of ``(H, W, 3)``.

    Raises:
        DataError: the image is truncated, damaged, larger than ``MAX_SIDE``, or not of size ``stored``.
    """
    try:
        with Image.open(BytesIO(image) if isinstance(image, bytes) else image) as opened:
            _check_sides(opened.size, name)
            if stored is not None and opened.size != stored[::-1]:
                raise DataError(
                    f"{name} is {opened.size[0]}x{opened.size[1]}, not {stored[1]}x{stored[0]} as the others"
                )
            size = opened.size if image_size is None else image_size[::-1]
            # A JPEG decodes at ½, ¼ or ⅛ of its size for less time, but not below what is asked for.
            opened.draft("RGB", size)
            pixels = opened if opened.mode == "RGB" else opened.convert("RGB")
            if pixels.size != size:
                pixels = pixels.resize(size, Image.Resampling.BILINEAR)
            array = np.array(pixels)
    except _UNREADABLE as error:
        raise DataError(f"cannot read the image {name} ({error}): copy or export it again") from error
    return torch.from_numpy(array).permute(2, 0, 1)


def resize(pixels: NDArray[np.uint8], image_size: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize ``(H, W, 3)`` pixels to ``image_size`` (H, W) as the images of files are."""
    return np.array(Image.fromarray(pixels).resize(image_size[::-1], Image.Resampling.BILINEAR))


def has_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether images of two sizes ``(H, W)`` have one aspect, so that one may be the other resized."""
    return abs((size[1] / size[0]) / (other[1] / other[0]) - 1) <= _SAME_ASPECT


def is_turned(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether images of one size ``(H, W)`` have the shape of another's turned by 90°, and not its own."""
    return has_shape(size, other[::-1]) and not has_shape(size, other)


def box_within(size: tuple[int, int], canvas: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return where images of one size lie when they are brought to another, (left, top, right, bottom).

    Images of the same aspect fill it all. Others keep their aspect: they are scaled until they just fit and
    put into the middle, to a pixel.

    Args:
        size: ``(H, W)`` of the images.
        canvas: ``(H, W)`` to which they are brought.
    """
    height, width = canvas
    if has_shape(size, canvas):
        return 0, 0, width, height
    scale = min(height / size[0], width / size[1])
    h, w = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
    left, top = (width - w) // 2, (height - h) // 2
    return left, top, left + w, top + h


def fill_up(
    pixels: NDArray[np.uint8],
    box: Sequence[float],
    canvas: tuple[int, int],
    image_size: tuple[int, int] | None = None,
) -> NDArray[np.uint8]:
    """Return an image of a larger size that shows pixels in a box and ``FILL`` around them.

    Args:
        pixels: ``(h, w, 3)``.
        box: left, top, right and bottom of where they come to lie on the canvas.
        canvas: ``(H, W)``.
        image_size: ``(H', W')`` to which the canvas is resized; None: as it is.

    Returns:
        ``(H', W', 3)``. Where the box ends within a pixel, that pixel is filled up.
    """
    height, width = image_size or canvas
    scale_x, scale_y = width / canvas[1], height / canvas[0]
    left, top, right, bottom = box[0] * scale_x, box[1] * scale_y, box[2] * scale_x, box[3] * scale_y
    # Whole pixels, and the part of the picture that they show: its place stays exact.
    x0, y0 = math.ceil(left - _ROUNDING), math.ceil(top - _ROUNDING)
    x1, y1 = math.floor(right + _ROUNDING), math.floor(bottom + _ROUNDING)
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = FILL
    if x1 > x0 and y1 > y0:
        rows, columns = pixels.shape[:2]
        across, down = columns / (right - left), rows / (bottom - top)
        part = (
            max((x0 - left) * across, 0.0),
            max((y0 - top) * down, 0.0),
            min((x1 - left) * across, columns),
            min((y1 - top) * down, rows),
        )
        shown = Image.fromarray(pixels).resize((x1 - x0, y1 - y0), Image.Resampling.BILINEAR, box=part)
        image[y0:y1, x0:x1] = np.array(shown)
    return image


def read_frames(
    read: Callable[[int], Tensor],
    num_frames: int,
    chosen: Sequence[int],
    *,
    where: Path,
    min_views: int = MIN_VIEWS,
) -> tuple[Tensor, list[int]]:
    """Read the chosen frames; an unreadable one is replaced by the nearest one not yet taken.

    If all frames are taken the nearest readable one comes twice, so that there are N images in any case.

    Args:
        read: returns ``(3, H, W)`` uint8 of the frame at a position, or raises DataError if it is damaged.
        num_frames: number of frames of the scan.
        chosen: positions of N of them.
        where: what to name in messages.
        min_views: fewest different images, or as many as were chosen if that is less.

    Returns:
        ``(N, 3, H, W)`` uint8 and the N positions that were read.

    Raises:
        DataError: fewer than ``min_views`` different images can be read.
    """
    reader = _Reader(read, len(chosen))
    good = [position for position in chosen if reader.can_read(position)]
    for position in [position for position in chosen if position in reader.failed]:
        near_to_far = np.argsort(np.abs(np.arange(num_frames) - position), kind="stable").tolist()
        # The nearest frame that is not used yet, or if there is none the nearest that is used comes again.
        unused = (other for other in near_to_far if other not in good and reader.can_read(other))
        used_again = (other for other in near_to_far if other in good)
        replacement = next(unused, next(used_again, None))
        if replacement is not None:
            good.append(replacement)
    if reader.failed:
        first = next(iter(reader.failed.values()))
        _warn_once(f"skipped {len(reader.failed)} unreadable images of {where}: {first}")
    if len(set(good)) < min(min_views, len(chosen)):
        raise DataError(
            f"only {len(set(good))} of {num_frames} usable frames in {where} can be read and "
            f"{min_views} are needed: copy or export them again"
        )
    used = sorted(good)
    return reader.images_at(used), used


class _Reader:
    """Reads each image of a scan at most once, into one tensor, and records those that cannot be read."""

    def __init__(self, read: Callable[[int], Tensor], count: int) -> None:
        self.failed: dict[int, DataError] = {}
        self._read, self._count = read, count
        self._images = torch.empty(0)
        self._row: dict[int, int] = {}

    def can_read(self, position: int) -> bool:
        """Read the image at ``position``, if that was not tried before, and return whether it is there."""
        if position not in self._row and position not in self.failed:
            try:
                image = self._read(position)
            except DataError as error:
                self.failed[position] = error
                return False
            if not self._row:
                self._images = torch.empty(self._count, *image.shape, dtype=image.dtype)
            self._row[position] = len(self._row)
            # Copied at once, so that all images reuse the memory of one: new memory costs more than the copy.
            self._images[self._row[position]] = image
        return position in self._row

    def images_at(self, positions: Sequence[int]) -> Tensor:
        """Return the images at positions that were read, ``(N, 3, H, W)``."""
        rows = [self._row[position] for position in positions]
        return self._images if rows == list(range(self._count)) else self._images[rows]


def stored_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Return the most frequent ``(H, W)`` of the images whose headers can be read.

    Raises:
        DataError: there is none, or they are larger than ``MAX_SIDE``.
    """
    sizes = Counter(size for size in stored_sizes(paths) if size is not None)
    if not sizes:
        if paths and paths[0].is_file():
            _size_of(paths[0])  # It may say why.
        raise DataError(f"no image in {paths[0].parent} can be read: copy or export them again")
    return sizes.most_common(1)[0][0]


def stored_sizes(paths: Sequence[Path]) -> list[tuple[int, int] | None]:
    """Return ``(H, W)`` of each image, None where its header cannot be read or claims too many pixels."""
    sizes: list[tuple[int, int] | None] = []
    for path in paths:
        try:
            sizes.append(_size_of(path))
        except DataError:
            sizes.append(None)
    return sizes


def _size_of(path: Path) -> tuple[int, int] | None:
    """Return ``(H, W)`` of an image, None if its header cannot be read.

    Raises:
        DataError: it is larger than ``MAX_SIDE``.
    """
    try:
        with Image.open(path) as image:
            _check_sides(image.size, str(path))
            return image.size[1], image.size[0]
    except _UNREADABLE:
        return None


def _check_sides(size: tuple[int, int], name: str) -> None:
    if max(size) > MAX_SIDE:
        raise DataError(
            f"{name} claims {size[0]}x{size[1]} pixels, and at most {MAX_SIDE} a side are read: make the "
            "images smaller, and scale the first row of the intrinsics by W'/W and the second by H'/H"
        )


@cache
def _warn_once(message: str) -> None:
    _log.warning(message)
