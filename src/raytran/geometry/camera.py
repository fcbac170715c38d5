# SPDX-License-Identifier: Apache-2.0
"""Pinhole cameras: rays out of cells, points into images.

Image coordinates run from (0, 0), the top-left corner of the top-left pixel, to (W, H) (COLMAP's
convention). Cameras are OpenCV: x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.errors import ShapeError, check_shape
from raytran.structs import Views, kept_on_device


@dataclass(frozen=True)
class Cameras:
    """A set of pinhole cameras that share an image size.

    Attributes:
        intrinsics: ``(..., 3, 3)`` for images of ``image_size``, pixels.
        world_from_camera: ``(..., 4, 4)``.
        image_size: ``(H, W)``.

    Raises:
        ShapeError: a tensor has another shape, or the leading shapes differ.
    """

    intrinsics: Tensor
    world_from_camera: Tensor
    image_size: tuple[int, int]

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

    @staticmethod
    def of(views: Views) -> Cameras:
        """Return the cameras that took the views, of leading shape ``(B, N)``."""
        return Cameras(views.intrinsics, views.world_from_camera, views.image_size)

    def select(self, views: slice) -> Cameras:
        """Return some of the N cameras of each scene, both of leading shape ``(B, N)``."""
        return Cameras(self.intrinsics[:, views], self.world_from_camera[:, views], self.image_size)

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
        return Cameras(torch.stack(rows, dim=-2), self.world_from_camera, (height, width))

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
