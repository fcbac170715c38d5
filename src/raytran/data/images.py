# SPDX-License-Identifier: Apache-2.0
"""Reading and resizing the images of a scan, some of which may be damaged."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from raytran.errors import DataError

_log = logging.getLogger(__name__)

MIN_VIEWS = 2
"""Fewest different frames from which a scene is reconstructed."""

_UNREADABLE = (OSError, SyntaxError, ValueError)
"""What Pillow raises for files that are truncated, damaged or no images."""


def read_image(path: Path, image_size: tuple[int, int], *, stored: tuple[int, int] | None = None) -> Tensor:
    """Read an image and resize it, not keeping its aspect.

    Args:
        path: a JPEG or PNG file.
        image_size: ``(H, W)`` wanted.
        stored: ``(H, W)`` that the file must have, or None for any.

    Returns:
        ``(3, H, W)`` uint8 RGB, a view of ``(H, W, 3)``.

    Raises:
        DataError: the file is truncated, damaged, or of another size than ``stored``.
    """
    height, width = image_size
    try:
        with Image.open(path) as image:
            if stored is not None and image.size != stored[::-1]:
                raise DataError(
                    f"{path} is {image.size[0]}x{image.size[1]}, not {stored[1]}x{stored[0]} as the others"
                )
            # A JPEG decodes at ½, ¼ or ⅛ of its size for less time, but not below what is asked for.
            image.draft("RGB", (width, height))
            pixels = image if image.mode == "RGB" else image.convert("RGB")
            if pixels.size != (width, height):
                pixels = pixels.resize((width, height), Image.Resampling.BILINEAR)
            array = np.array(pixels)
    except _UNREADABLE as error:
        raise DataError(f"cannot read the image {path} ({error}): copy or export it again") from error
    return torch.from_numpy(array).permute(2, 0, 1)


def read_images(
    paths: Sequence[Path],
    chosen: Sequence[int],
    *,
    image_size: tuple[int, int],
    stored: tuple[int, int],
    min_views: int = MIN_VIEWS,
) -> tuple[Tensor, list[int]]:
    """Read the chosen images; an unreadable one is replaced by the nearest one not yet taken.

    If all images are taken the nearest readable one comes twice, so the number of images stays N.

    Args:
        paths: every image of the scan.
        chosen: positions of N of them.
        image_size: ``(H, W)`` wanted.
        stored: ``(H, W)`` of the files.
        min_views: fewest different images, or as many as were chosen if that is less.

    Returns:
        ``(N, 3, H, W)`` uint8 and the N positions that were read.

    Raises:
        DataError: fewer than ``min_views`` different images can be read.
    """
    reader = _Reader(paths, image_size, stored)
    good = [position for position in chosen if reader.can_read(position)]
    for position in [position for position in chosen if position in reader.failed]:
        near_to_far = np.argsort(np.abs(np.arange(len(paths)) - position), kind="stable").tolist()
        fresh = (other for other in near_to_far if other not in good and reader.can_read(other))
        again = (other for other in near_to_far if other in good)
        good.extend(other for other in [next(fresh, next(again, -1))] if other >= 0)
    if reader.failed:
        first = next(iter(reader.failed.values()))
        _warn_once(f"skipped {len(reader.failed)} unreadable images of {paths[0].parent.parent}: {first}")
    if len(set(good)) < min(min_views, len(chosen)):
        raise DataError(
            f"only {len(set(good))} of {len(paths)} usable frames in {paths[0].parent} can be read and "
            f"{min_views} are needed: copy or export them again"
        )
    used = sorted(good)
    return torch.stack([reader.images[position] for position in used]), used


class _Reader:
    """Reads each image of a scan at most once and remembers those that cannot be read."""

    def __init__(self, paths: Sequence[Path], image_size: tuple[int, int], stored: tuple[int, int]) -> None:
        self.images: dict[int, Tensor] = {}
        self.failed: dict[int, DataError] = {}
        self._paths, self._image_size, self._stored = paths, image_size, stored

    def can_read(self, position: int) -> bool:
        """Read the image at ``position``, if that was not tried before, and return whether it is there."""
        if position not in self.images and position not in self.failed:
            try:
                self.images[position] = read_image(
                    self._paths[position], self._image_size, stored=self._stored
                )
            except DataError as error:
                self.failed[position] = error
        return position in self.images


def stored_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Return ``(H, W)`` of the first image whose header can be read.

    Raises:
        DataError: there is none.
    """
    for path in paths:
        try:
            with Image.open(path) as image:
                return image.size[1], image.size[0]
        except _UNREADABLE:
            continue
    raise DataError(f"no image in {paths[0].parent} can be read: copy or export them again")


@cache
def _warn_once(message: str) -> None:
    _log.warning(message)
