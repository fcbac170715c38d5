# SPDX-License-Identifier: Apache-2.0
"""Position encodings: sines and cosines of points in the volume, and the six numbers that describe a ray."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid

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
    steps = torch.linspace(0, 1, count, dtype=points.dtype, device=points.device)
    cycles = LOWEST * (HIGHEST / LOWEST) ** steps
    angle = (2 * math.pi * points / points.new_tensor(list(extent)))[..., None] * cycles
    code = torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(-2)
    return torch.nn.functional.pad(code, (0, channels - 6 * count))


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
