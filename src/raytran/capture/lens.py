# SPDX-License-Identifier: Apache-2.0
"""Lenses with distortion, and resampling their images to one pinhole camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from raytran.data.images import MAX_SIDE
from raytran.errors import DataError

_SAME_PX = 0.25
"""Largest shift of a pixel for which an image is used as it is."""

_SAME_FOCAL = 0.1
"""Largest relative difference of focal lengths, of one walk; autofocus moves them by 2 %."""

_SAME_ASPECT = 0.01
_OFF_CENTRE = 0.15
"""Largest distance of the principal point from the image centre, in widths or heights."""

_MOST_ZOOM = 1.5


@dataclass(frozen=True)
class Lens:
    """A perspective camera with the distortion of OpenCV's and COLMAP's models; may be compared and hashed.

    A point (x, y) at depth one is imaged at ``focal · d(x, y) + center``, where d scales it by
    ``(1 + Σ radialᵢ r²ⁱ) / (1 + Σ divisorᵢ r²ⁱ)`` and shifts it by the tangential part (OpenCV, "Camera
    Calibration and 3D Reconstruction").

    Attributes:
        size: ``(H, W)`` of its images.
        focal: fx, fy in pixels.
        center: cx, cy in pixels from the image's corner.
        radial: k1, k2, ... of the numerator.
        divisor: coefficients of the denominator, OpenCV's k4, k5, k6.
        tangential: p1, p2.
    """

    size: tuple[int, int]
    focal: tuple[float, float]
    center: tuple[float, float]
    radial: tuple[float, ...] = ()
    divisor: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def matrix(self) -> Tensor:
        """``(3, 3)`` float64 intrinsics, distortion left out."""
        (fx, fy), (cx, cy) = self.focal, self.center
        return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)

    @property
    def is_pinhole(self) -> bool:
        """Whether it does not distort."""
        return not any((*self.radial, *self.divisor, *self.tangential))

    def scaled_to(self, size: tuple[int, int]) -> Lens:
        """Return the lens of the same images resized to ``size`` (H, W)."""
        down, across = size[0] / self.size[0], size[1] / self.size[1]
        (fx, fy), (cx, cy) = self.focal, self.center
        return replace(self, size=size, focal=(fx * across, fy * down), center=(cx * across, cy * down))

    def distort(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where points ``(..., 2)`` of the plane at depth one seem to be."""
        square = (points**2).sum(axis=-1, keepdims=True)
        powers = [square ** (i + 1) for i in range(max(len(self.radial), len(self.divisor)))]
        above = 1 + sum((k * p for k, p in zip(self.radial, powers, strict=False)), np.zeros_like(square))
        below = 1 + sum((k * p for k, p in zip(self.divisor, powers, strict=False)), np.zeros_like(square))
        p1, p2 = self.tangential
        cross = 2 * points[..., :1] * points[..., 1:]
        shift = np.array([p2, p1]) * (square + 2 * points**2) + np.array([p1, p2]) * cross
        return points * (above / below) + shift

    def image_of(self, pinhole: Lens, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return this lens's pixels ``(..., 2)`` that show what a pinhole with the same pose shows in its."""
        plane = (pixels - np.array(pinhole.center)) / np.array(pinhole.focal)
        return self.distort(plane) * np.array(self.focal) + np.array(self.center)


def check_lens(lens: Lens, where: str) -> Lens:
    """Return the lens if it can be one.

    Args:
        lens: what a file says.
        where: name of the camera in the message, e.g. ``camera 1 in cameras.txt``.

    Raises:
        DataError: sizes or focal lengths are not positive, numbers are not finite, the image is larger than
            ``MAX_SIDE``, the principal point is far off the centre, or the distortion folds the image.
    """
    numbers = (*lens.focal, *lens.center, *lens.radial, *lens.divisor, *lens.tangential)
    if not np.isfinite(numbers).all() or min(lens.focal) <= 0:
        raise DataError(f"{where} has no positive, finite focal lengths and centre: calibrate it again")
    height, width = lens.size
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
        raise DataError(
            f"{where} is for images of {width}x{height}, and 1 to {MAX_SIDE} pixels a side are read: "
            "shrink the images, and the intrinsics with them"
        )
    off = max(abs(lens.center[0] / width - 0.5), abs(lens.center[1] / height - 0.5))
    if off > _OFF_CENTRE:
        raise DataError(
            f"{where} has its principal point at ({lens.center[0]:.1f}, {lens.center[1]:.1f}), far from the "
            f"middle of {width}x{height}: give the intrinsics of the stored images"
        )
    radius = np.linspace(0, 1, 65)[:, None] * np.hypot(width / lens.focal[0], height / lens.focal[1]) / 2
    seen = replace(lens, tangential=(0.0, 0.0)).distort(radius * np.array([1.0, 0.0]))[:, 0]
    if not (np.diff(seen) > 0).all():
        raise DataError(
            f"the distortion of {where} folds the image onto itself: calibrate it again, or undistort the "
            "images (COLMAP: image_undistorter)"
        )
    return lens


def shared_pinhole(lenses: Sequence[Lens], where: Path) -> Lens:
    """Return the pinhole camera to which the images of all lenses are resampled.

    It has the most frequent image size and the median focal length and centre; if lenses distort it is zoomed
    until no image leaves a corner empty.

    Args:
        lenses: one per frame.
        where: file to name in the message.

    Raises:
        DataError: the lenses are too different to be of one camera.
    """
    sizes = [lens.size for lens in lenses]
    size = max(sorted(set(sizes)), key=sizes.count)
    numbers = np.array([(*lens.focal, *lens.center) for lens in (lens.scaled_to(size) for lens in lenses)])
    middle = np.median(numbers, axis=0)
    aspect = np.array([(s[1] / s[0]) / (size[1] / size[0]) for s in sizes])
    if np.abs(numbers[:, :2] / middle[:2] - 1).max() > _SAME_FOCAL or np.abs(aspect - 1).max() > _SAME_ASPECT:
        other = int(np.abs(numbers[:, :2] / middle[:2] - 1).max(axis=1).argmax())
        other = int(np.abs(aspect - 1).argmax()) if np.abs(aspect - 1).max() > _SAME_ASPECT else other
        raise DataError(
            f"{where} has images of different cameras, {size[1]}x{size[0]} with a focal length of "
            f"{middle[0]:.0f} pixels and {sizes[other][1]}x{sizes[other][0]} with "
            f"{lenses[other].focal[0]:.0f}: give the images of one camera, held one way, at a time"
        )
    fx, fy, cx, cy = (float(value) for value in middle)
    pinhole = Lens(size, (fx, fy), (cx, cy))
    different = set(lenses)
    for zoom in np.arange(1.0, _MOST_ZOOM, 0.01).tolist():
        zoomed = replace(pinhole, focal=(fx * zoom, fy * zoom))
        if all(_fills(lens, zoomed) for lens in different):
            return zoomed
    return pinhole


def needs_resampling(lens: Lens, pinhole: Lens) -> bool:
    """Whether a lens's images differ from those of a pinhole camera."""
    if lens == pinhole:
        return False
    border = _border(pinhole.size)
    shift = lens.scaled_to(pinhole.size).image_of(pinhole, border) - border
    return float(np.abs(shift).max()) > _SAME_PX


def resample(image: NDArray[np.uint8], lens: Lens, pinhole: Lens) -> NDArray[np.uint8]:
    """Return what a pinhole camera would have seen, by bilinear interpolation.

    Args:
        image: ``(H, W, 3)`` of the lens, in any size.
        lens: of the image.
        pinhole: with the same pose.

    Returns:
        ``(H, W, 3)``.
    """
    height, width = image.shape[:2]
    source = torch.from_numpy(image).permute(2, 0, 1)[None].float()
    grid = _sampling_grid(lens, pinhole, (height, width))
    sampled = grid_sample(source, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled[0].round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).numpy()


@lru_cache(maxsize=4)
def _sampling_grid(lens: Lens, pinhole: Lens, size: tuple[int, int]) -> Tensor:
    """Return ``(1, H, W, 2)`` places in the lens's image, from -1 to 1 between its corners."""
    target = pinhole.scaled_to(size)
    column, row = np.meshgrid(np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5)
    pixels = lens.image_of(target, np.stack([column, row], axis=-1))
    places = 2 * pixels / np.array([lens.size[1], lens.size[0]]) - 1
    return torch.from_numpy(places.astype(np.float32))[None]


def _fills(lens: Lens, pinhole: Lens) -> bool:
    """Whether the lens's image shows everything that the pinhole sees, up to a pixel."""
    shown = lens.image_of(pinhole, _border(pinhole.size))
    return bool((shown >= -1).all() and (shown <= np.array(lens.size[::-1]) + 1).all())


def _border(size: tuple[int, int]) -> NDArray[np.float64]:
    """Return ``(64, 2)`` points (u, v) along the border of an image."""
    step, height, width = np.arange(16) / 16, size[0], size[1]
    zero, one = np.zeros(16), np.ones(16)
    sides = [(step, zero), (one, step), (1 - step, one), (zero, 1 - step)]
    return np.concatenate([np.stack([u * width, v * height], axis=1) for u, v in sides])
