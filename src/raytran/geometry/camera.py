# SPDX-License-Identifier: Apache-2.0
"""Pinhole cameras: rays out of cells, points into images.

Image coordinates run from (0, 0), the top-left corner of the top-left pixel, to (W, H) (COLMAP's
convention). Cameras are OpenCV: x right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.errors import ShapeError, check_shape
from raytran.structs import Views, kept_on_device

FARTHEST_CENTER = 1.0
"""Farthest that the principal point of a picture, cropped from a larger one, lies from its middle, in widths
or heights: half a picture outside of it."""

_OFF_CENTER = 0.15
"""Distance up to which the principal point of a picture that is not cropped lies from its middle."""

_SAME = 0.03
"""Relative difference up to which two aspects are taken for the same."""

CameraIndex = int | slice | Sequence[int] | Tensor | tuple[slice | int, ...] | None
"""What chooses some of a set of cameras."""


@dataclass(frozen=True)
class Cameras:
    """A set of pinhole cameras that share an image size.

    Attributes:
        intrinsics: ``(..., 3, 3)`` for images of ``image_size``, pixels.
        world_from_camera: ``(..., 4, 4)``.
        image_size: ``(H, W)``.
        picture: ``(..., 4)`` left, top, right and bottom of what each camera took within its image, pixels;
            it sees nothing outside of it. None: every image is all picture.

    Raises:
        ShapeError: a tensor has another shape, or the leading shapes differ.
    """

    intrinsics: Tensor
    world_from_camera: Tensor
    image_size: tuple[int, int]
    picture: Tensor | None = None

    def __post_init__(self) -> None:
        if self.intrinsics.shape[-2:] != (3, 3):
            check_shape(self.intrinsics, "... 3 3", "intrinsics")
        if self.world_from_camera.shape[-2:] != (4, 4):
            check_shape(self.world_from_camera, "... 4 4", "world_from_camera")
        if self.intrinsics.shape[:-2] != self.world_from_camera.shape[:-2]:
            raise ShapeError(
                "expected as many intrinsics as poses, got "
                f"{tuple(self.intrinsics.shape[:-2])} and {tuple(self.world_from_camera.shape[:-2])}"
            )
        if self.picture is not None and self.picture.shape != (*self.intrinsics.shape[:-2], 4):
            check_shape(self.picture, "... 4", "picture")
            raise ShapeError(
                "expected as many pictures as intrinsics, got "
                f"{tuple(self.picture.shape[:-1])} and {tuple(self.intrinsics.shape[:-2])}"
            )

    @staticmethod
    def of(views: Views) -> Cameras:
        """Return the cameras that took the views, of leading shape ``(B, N)``."""
        return Cameras(views.intrinsics, views.world_from_camera, views.image_size, views.picture)

    def __getitem__(self, index: CameraIndex) -> Cameras:
        """Return some of the cameras, chosen along the leading dimensions as those of a tensor are."""
        picture = None if self.picture is None else self.picture[index]
        return Cameras(self.intrinsics[index], self.world_from_camera[index], self.image_size, picture)

    def select(self, views: slice) -> Cameras:
        """Return some of the N cameras of each scene, both of leading shape ``(B, N)``."""
        return self[:, views]

    def to(self, target: torch.device | torch.dtype | str) -> Cameras:
        """Return the cameras on another device or in another floating-point type."""
        picture = None if self.picture is None else self.picture.to(target)
        return Cameras(
            self.intrinsics.to(target), self.world_from_camera.to(target), self.image_size, picture
        )

    @property
    def position(self) -> Tensor:
        """``(..., 3)`` optical centres in the world."""
        return self.world_from_camera[..., :3, 3]

    def scaled_to(self, image_size: tuple[int, int]) -> Cameras:
        """Return the cameras of the same images resized to ``image_size`` ``(H', W')``.

        The first row of K is scaled by W'/W and the second by H'/H, so the resize need not keep the aspect.
        """
        height, width = image_size
        # Row by row: to put the factors into a tensor on a GPU would make the host wait for it.
        first, second, third = self.intrinsics.unbind(dim=-2)
        rows = [first * (width / self.image_size[1]), second * (height / self.image_size[0]), third]
        matrices = torch.stack(rows, dim=-2)
        return Cameras(matrices, self.world_from_camera, (height, width), self._scaled_picture(image_size))

    def quarter_turned(self) -> Cameras:
        """Return the cameras of the same images turned counter-clockwise by 90°: their right side is on top.

        The new x axis is the old y axis, the new y axis the old -x axis. K has no skew.
        """
        height, width = self.image_size
        right, down, others = self.world_from_camera.split([1, 1, 2], dim=-1)
        fx, fy = self.intrinsics[..., 0, 0], self.intrinsics[..., 1, 1]
        cx, cy = self.intrinsics[..., 0, 2], self.intrinsics[..., 1, 2]
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        matrices = torch.stack([fy, zero, cy, zero, fx, width - cx, zero, zero, one], dim=-1)
        picture = self.picture
        if picture is not None:
            left, top, last_column, bottom = picture.unbind(dim=-1)
            picture = torch.stack([top, width - last_column, bottom, width - left], dim=-1)
        pose = torch.cat([down, -right, others], dim=-1)
        return Cameras(matrices.unflatten(-1, (3, 3)), pose, (width, height), picture)

    def _scaled_picture(self, image_size: tuple[int, int]) -> Tensor | None:
        """Return ``picture`` in images resized to ``image_size`` ``(H', W')``."""
        if self.picture is None:
            return None
        scale_y, scale_x = image_size[0] / self.image_size[0], image_size[1] / self.image_size[1]
        sides = zip(self.picture.unbind(dim=-1), (scale_x, scale_y, scale_x, scale_y), strict=True)
        return torch.stack([side * scale for side, scale in sides], dim=-1)

    def cell_rays(self, feature_size: tuple[int, int], rays_per_cell: int = 1) -> tuple[Tensor, Tensor]:
        """Cast rays through the cells of an ``h × w`` map laid over the image.

        A cell is cut into n×n equal parts and a ray goes through the centre of each; with n = 1 the ray of
        cell (r, c) passes through u = (c+½)·W/w, v = (r+½)·H/h.

        Args:
            feature_size: ``(h, w)``.
            rays_per_cell: n.

        Returns:
            origins ``(..., 1, 1, 1, 3)`` and directions ``(..., h, w, n·n, 3)`` in the world; the directions
            have unit depth along the camera's z axis, so a ray parameter is a depth in metres.
        """
        height, width = feature_size
        scaled = self.scaled_to((height, width))
        n = rays_per_cell
        dtype, device = self.intrinsics.dtype, self.intrinsics.device
        image = _points_of_cells(height, width, n, dtype, device=device)
        # On a GPU an error check would make the host wait.
        inverse, _ = torch.linalg.inv_ex(scaled.intrinsics, check_errors=scaled.intrinsics.is_cpu)
        world_from_image = self.world_from_camera[..., :3, :3] @ inverse
        rays = torch.einsum("...ij,kj->...ki", world_from_image, image)
        directions = rays.unflatten(-2, (height, width, n * n))
        return self.position[..., None, None, None, :], directions

    def cells_in_picture(self, feature_size: tuple[int, int], rays_per_cell: int = 1) -> Tensor | None:
        """Return which rays of ``cell_rays`` pass through the picture, ``(..., h, w, n·n)`` bool.

        Args:
            feature_size: ``(h, w)``.
            rays_per_cell: n.

        Returns:
            None if every image is all picture.
        """
        picture = self._scaled_picture(feature_size)
        if picture is None:
            return None
        (height, width), n = feature_size, rays_per_cell
        points = _points_of_cells(height, width, n, self.intrinsics.dtype, device=self.intrinsics.device)
        u, v, _ = points.view(height, width, n * n, 3).unbind(dim=-1)
        left, top, right, bottom = picture[..., None, None, None, :].unbind(dim=-1)
        return (u >= left) & (u < right) & (v >= top) & (v < bottom)

    def sees(self, pixels: Tensor, depth: Tensor) -> Tensor:
        """Return which projected points are in front of the camera and in its picture, ``(..., n)`` bool.

        Args:
            pixels: ``(..., n, 2)`` that ``project`` returned.
            depth: ``(..., n)`` that ``project`` returned.
        """
        if self.picture is None:
            height, width = self.image_size
            inside = (pixels >= 0).all(dim=-1) & (pixels[..., 0] < width) & (pixels[..., 1] < height)
        else:
            picture = self.picture[..., None, :]
            inside = ((pixels >= picture[..., :2]) & (pixels < picture[..., 2:])).all(dim=-1)
        return inside & (depth > 0)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project world points into the images.

        Args:
            points: ``(..., n, 3)`` metres, leading dimensions broadcast against the cameras'.

        Returns:
            pixels ``(..., n, 2)`` as (u, v), and depths ``(..., n)`` in metres. Pixels of points at or behind
            the camera plane (depth ≤ 0) have no meaning.
        """
        rotation = self.world_from_camera[..., :3, :3]
        in_camera = (points - self.position[..., None, :]) @ rotation
        in_image = in_camera @ self.intrinsics.transpose(-1, -2)
        depth = in_camera[..., 2]
        return in_image[..., :2] / in_image[..., 2:].where(in_image[..., 2:] != 0, 1.0), depth


def center_offset(center: tuple[float, float], image_size: tuple[int, int]) -> float:
    """Return the distance of a principal point (cx, cy) from the middle of ``(H, W)``, in widths or heights.

    Of the distances along both axes it is the greater one.
    """
    return max(abs(center[0] / image_size[1] - 0.5), abs(center[1] / image_size[0] - 0.5))


def is_off_center(center: tuple[float, float], image_size: tuple[int, int]) -> bool:
    """Whether a principal point is that of a crop, if its intrinsics are for images of ``(H, W)`` at all."""
    return center_offset(center, image_size) > _OFF_CENTER


def other_image_size(center: tuple[float, float], image_size: tuple[int, int]) -> tuple[int, int] | None:
    """Return for which other size ``(H, W)`` intrinsics seem to be, or None if they may be for this one.

    A principal point far from the middle is that of a crop, unless it is the middle of images of the same
    shape, of the shape turned by 90°, or of squares, as networks are given: then such images were resized.

    Args:
        center: cx, cy.
        image_size: ``(H, W)`` of the images.
    """
    width, height = 2 * center[0], 2 * center[1]
    if not is_off_center(center, image_size) or min(width, height) < 1:
        return None
    aspect = image_size[1] / image_size[0]
    same = any(abs(width / height / other - 1) < _SAME for other in (aspect, 1 / aspect, 1.0))
    return (round(height), round(width)) if same else None


@kept_on_device(16)
def _points_of_cells(height: int, width: int, n: int, dtype: torch.dtype, *, device: torch.device) -> Tensor:
    """Return (u, v, 1) of n×n points in every cell of a map, ``(h·w·n·n, 3)``; a cell is 1 wide."""
    part = (torch.arange(n, dtype=dtype, device=device) + 0.5) / n
    v = torch.arange(height, dtype=dtype, device=device)[:, None, None, None] + part[:, None]
    u = torch.arange(width, dtype=dtype, device=device)[None, :, None, None] + part
    v, u = torch.broadcast_tensors(v, u)
    return torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(-1, 3)


def pose_from_heading(
    eye: NDArray[np.float64], heading: float, down: float, roll: float
) -> NDArray[np.float64]:
    """Return the ``world_from_camera`` pose ``(4, 4)`` of a camera that looks in a direction.

    Args:
        eye: ``(3,)`` metres.
        heading: angle of the viewing direction about z from the x axis, radians.
        down: angle of the viewing direction below the horizon, radians.
        roll: turn about the viewing direction, radians.
    """
    forward = np.array([np.cos(heading) * np.cos(down), np.sin(heading) * np.cos(down), -np.sin(down)])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    below = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * below
    pose[:3, 1] = np.cos(roll) * below - np.sin(roll) * right
    pose[:3, 2] = forward
    pose[:3, 3] = eye
    return pose
