# SPDX-License-Identifier: Apache-2.0
"""A room larger than the voxel grid, covered by several grids that overlap and share their voxels' planes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid

OVERLAP = 1.5
"""Least overlap of neighbouring volumes, metres: an object between them lies wholly in one."""

AHEAD = 1.5
"""A volume is to hold the cameras, and the places this far ahead of them, metres."""

BESIDE = 0.5
"""Several volumes also hold what stands this far beside the outermost of these, metres."""

MOST = 256
"""More volumes than this are no room but positions in another unit."""

_FEWEST_VIEWS = 2
_FAR = 1e9


@dataclass(frozen=True)
class Volumes:
    """T voxel grids of one size, a whole number of voxels apart.

    Attributes:
        resolution: ``(X, Y, Z)`` of each.
        extent: sizes of each, metres.
        center: ``(T, 3)`` their centres in the world, metres.
    """

    resolution: tuple[int, int, int]
    extent: tuple[float, float, float]
    center: Tensor

    def __len__(self) -> int:
        return int(self.center.shape[0])

    def holds(self, points: Tensor) -> Tensor:
        """Return whether points ``(n, 3)`` lie in each volume, ``(n, T)`` bool."""
        return (self._offset(points).abs() <= 1).all(dim=-1)

    def owner(self, points: Tensor) -> Tensor:
        """Return to which volume points ``(n, 3)`` belong, ``(n,)`` int64.

        Of the volumes that hold a point, or of all where none does, it is the one whose middle is nearest.
        """
        outside = torch.where(self.holds(points), 0.0, _FAR)
        return (self._offset(points).square().sum(dim=-1) + outside).argmin(dim=1)

    def _offset(self, points: Tensor) -> Tensor:
        """Return where points are in each volume, ``(n, T, 3)``: 0 in the middle, -1 and 1 at the sides."""
        return (points[:, None].to(self.center) - self.center) * 2 / self.center.new_tensor(self.extent)

    def corner_index(self) -> Tensor:
        """Return where in ``joint`` each volume begins, ``(T, 3)`` int64 voxels."""
        voxel = self.center.new_tensor(self.extent) / self.center.new_tensor(self.resolution)
        return ((self.center - self.center.amin(dim=0)) / voxel).round().long()

    def joint(self) -> VoxelGrid:
        """Return the grid of the same voxels that just holds all volumes."""
        last = self.corner_index().amax(dim=0).tolist()
        x, y, z = (start + count for start, count in zip(last, self.resolution, strict=True))
        voxel = [length / count for length, count in zip(self.extent, self.resolution, strict=True)]
        extent = (x * voxel[0], y * voxel[1], z * voxel[2])
        return VoxelGrid((x, y, z), extent, (self.center.amin(dim=0) + self.center.amax(dim=0)) / 2)


def places_ahead(cameras: Cameras) -> Tensor:
    """Return the point ``AHEAD`` metres along the axis of each camera ``(n,)``, ``(n, 3)``."""
    return cameras.position + AHEAD * cameras.world_from_camera[..., :3, 2]


def cover(
    cameras: Cameras,
    *,
    resolution: tuple[int, int, int],
    extent: tuple[float, float, float],
    name: str = "the scene",
) -> tuple[Volumes, Tensor]:
    """Return the volumes in which a scene is predicted, and which cameras look into each.

    They hold all cameras and the places ahead of them. One volume is centred on the mean camera, as in
    training, or moved from there as little as it takes. Where one is too small, volumes that overlap by
    ``OVERLAP`` are laid side by side, those that no camera needs left out.

    Args:
        cameras: of the scene, ``(n,)``.
        resolution: ``(X, Y, Z)`` voxels of a volume.
        extent: sizes of a volume, metres.
        name: what to call the scene in messages.

    Returns:
        the volumes, and ``(T, n)`` bool: the camera, or the place ahead of it, lies in the volume; of a
        single volume all do.

    Raises:
        DataError: the cameras lie so far apart that their positions cannot be metres.
    """
    position = cameras.position.double()
    points = torch.cat([position, places_ahead(cameras).double()])
    low, high = points.amin(dim=0), points.amax(dim=0)
    mean = position.mean(dim=0)
    ends = torch.stack([low, high, mean], dim=1).tolist()
    axes = [
        _along_axis(*three, length=length, count=count)
        for three, length, count in zip(ends, extent, resolution, strict=True)
    ]
    number = math.prod(map(len, axes))
    if number > MOST:
        span = " x ".join(f"{length:.3g}" for length in (high - low).tolist())
        raise DataError(
            f"the cameras of {name} see {span} m, which takes more than {MOST} volumes of "
            f"{' x '.join(f'{length:g}' for length in extent)} m: give scale= (metres in a unit) if its "
            "positions are not metres, or the frames of one part of the building"
        )
    lattice = Volumes(resolution, extent, torch.cartesian_prod(*axes))
    if number == 1:
        return lattice, torch.ones(1, len(position), dtype=torch.bool)
    needed = torch.bincount(lattice.owner(points), minlength=number) > 0
    looks_into = lattice.holds(points).view(2, -1, number).any(dim=0).T
    used = needed & (looks_into.sum(dim=1) >= _FEWEST_VIEWS)
    return Volumes(resolution, extent, lattice.center[used]), looks_into[used]


def _along_axis(low: float, high: float, mean: float, *, length: float, count: int) -> Tensor:
    """Return the centres along an axis of volumes of one length, of ``count`` voxels, that cover a range."""
    if high - low <= length:
        return torch.tensor([min(max(mean, high - length / 2), low + length / 2)], dtype=torch.float64)
    low, high = low - BESIDE, high + BESIDE
    voxel = length / count
    longest_step = max(math.floor((length - min(OVERLAP, length / 2)) / voxel), 1)
    volumes = 1 + math.ceil((high - low - length) / (longest_step * voxel))
    step = math.ceil((high - low - length) / (volumes - 1) / voxel)
    # Positions in millimetres are refused by their number, and must not fill the memory first.
    volumes = min(volumes, MOST + 1)
    place = torch.arange(volumes, dtype=torch.float64) - (volumes - 1) / 2
    return (low + high) / 2 + place * step * voxel
