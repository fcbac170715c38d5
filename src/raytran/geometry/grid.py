# SPDX-License-Identifier: Apache-2.0
"""The voxel grid: a box of the world, cut into equal cells along the world's axes (RayTran §3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from raytran.errors import check_shape


@dataclass(frozen=True)
class VoxelGrid:
    """A grid of ``X × Y × Z`` voxels. Voxels are numbered x-major, z fastest.

    Attributes:
        resolution: ``(X, Y, Z)``.
        extent: sizes of the whole grid along x, y, z, metres.
        center: ``(..., 3)`` centre of the grid in the world, metres; leading dimensions are scenes.
    """

    resolution: tuple[int, int, int]
    extent: tuple[float, float, float]
    center: Tensor

    def __post_init__(self) -> None:
        center = torch.as_tensor(self.center)
        object.__setattr__(self, "center", center if center.is_floating_point() else center.float())
        object.__setattr__(self, "resolution", tuple(int(n) for n in self.resolution))
        object.__setattr__(self, "extent", tuple(float(length) for length in self.extent))
        if self.center.shape[-1:] != (3,):
            check_shape(self.center, "... 3", "center")

    @property
    def num_voxels(self) -> int:
        """Number of voxels of one scene."""
        x, y, z = self.resolution
        return x * y * z

    @property
    def voxel_size(self) -> Tensor:
        """``(3,)`` metres."""
        return self._vector(self.extent) / self._vector(self.resolution)

    @property
    def lower(self) -> Tensor:
        """``(..., 3)`` the corner with the smallest coordinates, metres."""
        return self.center - self._vector(self.extent) / 2

    def voxel_from_world(self, points: Tensor) -> Tensor:
        """Return continuous voxel coordinates of world points, both ``(..., n, 3)``; i spans [i, i+1]."""
        return (points - self.lower[..., None, :]) / self.voxel_size

    def world_from_voxel(self, coordinates: Tensor) -> Tensor:
        """Return the world points of continuous voxel coordinates, both ``(..., n, 3)``."""
        return coordinates * self.voxel_size + self.lower[..., None, :]

    def voxel_centers(self) -> Tensor:
        """Return the centres of all voxels in the world, ``(..., X, Y, Z, 3)``."""
        like = self.center
        axes = [torch.arange(n, dtype=like.dtype, device=like.device) + 0.5 for n in self.resolution]
        index = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
        return self.world_from_voxel(index).unflatten(-2, self.resolution)

    def flat_index(self, index: Tensor) -> Tensor:
        """Return the number of each voxel, int64 ``(...)``, of integer coordinates ``(..., 3)``."""
        _, y, z = self.resolution
        return (index[..., 0] * y + index[..., 1]) * z + index[..., 2]

    def _vector(self, values: tuple[float, ...]) -> Tensor:
        # Not torch.tensor: a copy to a GPU would make the host wait for it.
        return torch.stack([self.center.new_full((), value) for value in values])
