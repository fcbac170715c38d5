# SPDX-License-Identifier: Apache-2.0
"""Frames that together see the most of a volume, chosen from their cameras alone.

Greedy maximisation of a submodular gain (Nemhauser, Wolsey & Fisher 1978: at least 1 - 1/e of the best): the
n-th chosen frame that sees a place counts 1/n for it, so that what few have seen draws the next one. Walls
are not known, so a frame counts only for what is near it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from raytran.data.views import choose_even
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid

CELL = 0.4
"""About the side of the cells that are to be seen, metres: far coarser than voxels, and enough to compare."""

SIGHT = 2.5
"""Distance up to which a frame counts for what is in its image, metres: further on there may be a wall."""

NEAR_CM = 5.0
NEAR_DEG = 5.0
"""A camera that is both nearer and less turned than this is a near-duplicate."""


@dataclass(frozen=True)
class ViewChoice:
    """Which frames were chosen.

    Attributes:
        frames: positions of the chosen frames, ascending.
        near_duplicates: positions of those left out because they show what a chosen one shows.
    """

    frames: tuple[int, ...]
    near_duplicates: tuple[int, ...] = ()


def choose_by_coverage(cameras: Cameras, grid: VoxelGrid, count: int) -> ViewChoice:
    """Choose up to ``count`` frames that see as much of a volume as possible, near-duplicates left out.

    Args:
        cameras: of all frames, ``(n,)``.
        grid: the volume, ``center`` ``(3,)``; its resolution does not matter.
        count: most frames to choose; fewer come if all others are near-duplicates.
    """
    seen = visible_cells(cameras, _cells(grid)).float()
    if not seen.any():
        return ViewChoice(tuple(choose_even(len(seen), min(count, len(seen))).tolist()))
    near = near_duplicates(cameras)
    times_seen = torch.zeros(seen.shape[1])
    left = torch.ones(len(seen), dtype=torch.bool)
    frames: list[int] = []
    while len(frames) < count and left.any():
        gain = seen @ (1 / (1 + times_seen))
        best = int(gain.where(left, -1.0).argmax())
        frames.append(best)
        times_seen += seen[best]
        left &= ~near[best]
    beside = near[frames].any(dim=0).index_fill(0, torch.tensor(frames, dtype=torch.int64), False)
    return ViewChoice(tuple(sorted(frames)), tuple(beside.nonzero().squeeze(1).tolist()))


def near_duplicates(cameras: Cameras) -> Tensor:
    """Return which of the cameras ``(n,)`` show about the same, ``(n, n)`` bool; each shows what it does."""
    pose = cameras.world_from_camera.double()
    position, rotation = pose[:, :3, 3], pose[:, :3, :3].flatten(1)
    apart = (position[:, None] - position).norm(dim=-1)
    # The trace of a relative rotation is 1 + 2 · cos(angle).
    cosine = (rotation @ rotation.T - 1) / 2
    near = (apart < NEAR_CM / 100) & (cosine > math.cos(math.radians(NEAR_DEG)))
    return near | torch.eye(len(pose), dtype=torch.bool)


def visible_cells(cameras: Cameras, cells: Tensor) -> Tensor:
    """Return whether each camera has each point in its image and within ``SIGHT``, ``(n, V)`` bool.

    Args:
        cameras: ``(n,)``.
        cells: ``(V, 3)`` points of the world, metres.
    """
    cells = cells.to(cameras.intrinsics)
    pixels, depth = cameras.project(cells)
    height, width = cameras.image_size
    inside = (pixels >= 0).all(dim=-1) & (pixels[..., 0] < width) & (pixels[..., 1] < height) & (depth > 0)
    return inside & (torch.cdist(cameras.position, cells) < SIGHT)


def _cells(grid: VoxelGrid) -> Tensor:
    """Return the centres of the cells into which a volume is cut, ``(V, 3)``."""
    x, y, z = (max(1, math.ceil(length / CELL)) for length in grid.extent)
    return VoxelGrid((x, y, z), grid.extent, grid.center).voxel_centers().reshape(-1, 3)
