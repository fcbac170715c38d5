# SPDX-License-Identifier: Apache-2.0
"""The voxel grid: a box of the world, cut into equal cells along the world's axes (RayTran §3.1).

And how the network is given positions in it: sines and cosines of points, origin and direction of rays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from raytran.errors import ConfigError, check_shape
from raytran.geometry.camera import Cameras
from raytran.limits import BOX_SIDE
from raytran.setting_limits import MAX_CELLS, MAX_CELLS_A_SIDE, check_settings
from raytran.structs import constant, kept_on_device, sent_to


@dataclass(frozen=True)
class VoxelGrid:
    """A grid of ``X × Y × Z`` voxels. Voxels are numbered x-major, z fastest.

    Attributes:
        resolution: ``(X, Y, Z)``.
        extent: sizes of the whole grid along x, y, z, metres.
        center: ``(..., 3)`` centre of the grid in the world, metres; leading dimensions are scenes.

    Raises:
        ConfigError: a number of voxels or a size is not positive, not finite, or beyond all use.
        ShapeError: the centre has another shape.
    """

    resolution: tuple[int, int, int]
    extent: tuple[float, float, float]
    center: Tensor

    def __post_init__(self) -> None:
        center = torch.as_tensor(self.center)
        object.__setattr__(self, "center", center if center.is_floating_point() else center.float())
        if not _can_be(self.resolution, self.extent):
            checked_grid(self.resolution, self.extent)  # It says what is wrong.
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
        return _numbers(values, self.center)


def _numbers(values: Sequence[float], like: Tensor) -> Tensor:
    """Return fixed numbers as a vector, made so that no GPU is waited for."""
    if like.is_cpu:
        return torch.stack([like.new_full((), value) for value in values])
    return constant(tuple(values), like.dtype, device=like.device)


def _can_be(resolution: Sequence[int], extent: Sequence[float]) -> bool:
    """Whether a grid is as ``checked_grid`` wants it, told in few steps: grids are made in every pass."""
    if not len(resolution) == len(extent) == 3:
        return False
    x, y, z = resolution
    is_whole = type(x) is type(y) is type(z) is int
    cells = is_whole and min(x, y, z) > 0 and max(x, y, z) <= MAX_CELLS_A_SIDE and x * y * z <= MAX_CELLS
    return cells and BOX_SIDE.low <= min(extent) and max(extent) <= BOX_SIDE.high


def checked_grid(
    resolution: Sequence[int], extent: Sequence[float]
) -> tuple[tuple[int, int, int], tuple[float, float, float]]:
    """Return numbers of voxels and sizes of a grid, metres, that a grid can have.

    Raises:
        ConfigError: they are not three each, not positive, not finite, or beyond all use.
    """
    if len(resolution) != 3 or len(extent) != 3:
        raise ConfigError(
            f"a voxel grid has {len(resolution)} numbers of voxels and {len(extent)} sizes: give three each"
        )
    check_settings({"grid_resolution": list(resolution), "grid_extent": list(extent)})
    x, y, z = (int(n) for n in resolution)
    if x * y * z > MAX_CELLS:
        raise ConfigError(f"a voxel grid of {x} x {y} x {z} has more than {MAX_CELLS:,} voxels: give fewer")
    a, b, c = (float(length) for length in extent)
    return (x, y, z), (a, b, c)


LOWEST, HIGHEST = 0.5, 16.0
"""Waves that fit into the volume, of the lowest and of the highest frequency. Vaswani et al. (2017) span a
ratio of 10,000; over a voxel grid, waves outside of these would be constant or noise."""


def position_code(points: Tensor, extent: Sequence[float], channels: int) -> Tensor:
    """Return sines and cosines of the three coordinates at rising frequencies.

    Args:
        points: ``(..., 3)`` metres from the centre of the volume.
        extent: sizes of the volume, metres.
        channels: C; what exceeds a multiple of six is filled with zeros.

    Returns:
        ``(..., C)``.
    """
    count = channels // 6
    if points.is_cpu:
        cycles = _cycles(count, points.dtype, device=points.device)
        sides = _numbers(extent, points)
        angle = (2 * math.pi * points / sides)[..., None] * cycles
        code = torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(-2)
    else:
        # The same in few launches, and up to rounding: a cosine is the sine of a quarter more.
        waves, phase = _waves(count, tuple(extent), points.dtype, device=points.device)
        code = torch.addcmul(phase, points[..., None], waves).sin().flatten(-2)
    return torch.nn.functional.pad(code, (0, channels - 6 * count))


@kept_on_device(4)
def _cycles(count: int, dtype: torch.dtype, *, device: torch.device) -> Tensor:
    """Return how many waves of each frequency fit into the volume."""
    return LOWEST * (HIGHEST / LOWEST) ** torch.linspace(0, 1, count, dtype=dtype, device=device)


@kept_on_device(4)
def _waves(
    count: int, extent: tuple[float, ...], dtype: torch.dtype, *, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return radians per metre ``(3, 2 · count)``, and what is added to them, for sines and cosines."""
    here = torch.device("cpu")
    sides, quarters = (constant(values, torch.float64, device=here) for values in (extent, (0.0, 0.25)))
    waves = (2 * math.pi * _cycles(count, torch.float64, device=here) / sides[:, None]).repeat(1, 2)
    phase = 2 * math.pi * quarters.repeat_interleave(count)
    return sent_to(device, waves.to(dtype)), sent_to(device, phase.to(dtype))


@kept_on_device(2)
def centered_voxels(
    resolution: tuple[int, int, int],
    extent: tuple[float, float, float],
    dtype: torch.dtype,
    *,
    device: torch.device,
) -> Tensor:
    """Return the centres of all voxels from the centre of their volume, ``(X, Y, Z, 3)`` metres; kept."""
    return VoxelGrid(resolution, extent, torch.zeros(3, dtype=dtype, device=device)).voxel_centers()


@kept_on_device(2)
def voxel_code(
    resolution: tuple[int, int, int],
    extent: tuple[float, float, float],
    volume: tuple[float, ...],
    channels: int,
    dtype: torch.dtype,
    *,
    device: torch.device,
) -> Tensor:
    """Return ``position_code`` of all voxels in a volume, ``(X, Y, Z, C)``; kept: all scenes have one."""
    return position_code(centered_voxels(resolution, extent, dtype, device=device), volume, channels)


def ray_code(cameras: Cameras, grid: VoxelGrid, feature_size: Sequence[int]) -> Tensor:
    """Return origin, from the grid's centre in metres, and unit direction of the centre rays of cells.

    Args:
        cameras: of leading shape ``(B, N)``.
        grid: the voxel grids, ``center`` ``(B, 3)``.
        feature_size: ``(h, w)``.

    Returns:
        ``(B · N, h, w, 6)``.
    """
    origin, direction = cameras.cell_rays((feature_size[0], feature_size[1]))
    origin = origin[..., 0, :] - grid.center[:, None, None, None]
    direction = torch.nn.functional.normalize(direction[..., 0, :], dim=-1)
    return torch.cat([origin.expand_as(direction), direction], dim=-1).flatten(0, 1)
