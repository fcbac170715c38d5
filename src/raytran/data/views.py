# SPDX-License-Identifier: Apache-2.0
"""Which frames of a scene become its views: drawn at random, spread evenly, or chosen for what they see."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.structs import SceneBatch

_log = logging.getLogger(__name__)

CELL = 0.4
"""Side of the cells by which frames are compared, metres, about: far coarser than voxels."""

SIGHT = 2.5
"""Distance up to which a camera is taken to see a cell in its image, metres: beyond may be a wall."""

NEAR_CM = 5.0
NEAR_DEG = 5.0
"""A camera both nearer to another and less rotated against it than this is its near-duplicate."""


def choose_random(n: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw ``count`` of ``n`` frames, in the order of the video.

    No frame comes twice unless there are fewer than ``count``; then all come equally often, or once more.

    Args:
        n: frames to choose from, at least 1.
        count: frames wanted.
        generator: source of the randomness.

    Returns:
        ``(count,)`` int64, ascending.
    """
    order = torch.randperm(n, generator=generator)
    return order.repeat(-(-count // n))[:count].sort().values


def choose_even(n: int, count: int) -> Tensor:
    """Return the middles of ``count`` equal parts of a video of ``n`` frames.

    With fewer than ``count`` frames all of them come, repeated evenly.

    Args:
        n: frames to choose from, at least 1.
        count: frames wanted.

    Returns:
        ``(count,)`` int64, ascending.
    """
    return (2 * torch.arange(count) + 1) * n // (2 * count)


def hold_out(
    used: Sequence[int], count: int, generator: torch.Generator | None
) -> tuple[list[int], list[int]]:
    """Divide frames into those that the network sees and those to render; none is both.

    Args:
        used: N + count frames of a scene, some of which may come more than once.
        count: number of frames to hold out, fewer than there are different frames.
        generator: source of the randomness; None holds out evenly spread frames.

    Returns:
        the positions in ``used`` of the N frames to see, and of those held out. If a held-out frame comes
        more than once in ``used``, some frames to see are repeated to make up for it.
    """
    frames = sorted(set(used))
    chosen = (
        choose_even(len(frames), count) if generator is None else choose_random(len(frames), count, generator)
    )
    rendered = [frames[i] for i in chosen.tolist()]
    seen = [position for position, frame in enumerate(used) if frame not in rendered]
    seen = [seen[i] for i in choose_even(len(seen), len(used) - count).tolist()]
    return seen, [used.index(frame) for frame in rendered]


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
    """Choose up to ``count`` frames that see as much of a volume as possible, without near-duplicates.

    Greedy maximisation of a submodular gain (Nemhauser, Wolsey & Fisher 1978: at least 1 - 1/e of the best):
    the n-th chosen frame that sees a cell gains 1/n for it, so that cells which few frames have seen draw the
    next one. Walls are not known, so a frame counts only for the cells near its camera.

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
    left_out = near[frames].any(dim=0).index_fill(0, torch.tensor(frames, dtype=torch.int64), False)
    return ViewChoice(tuple(sorted(frames)), tuple(left_out.nonzero().squeeze(1).tolist()))


def near_duplicates(cameras: Cameras) -> Tensor:
    """Return which of the cameras ``(n,)`` show about the same, ``(n, n)`` bool; True on the diagonal."""
    pose = cameras.world_from_camera.double()
    position, rotation = pose[:, :3, 3], pose[:, :3, :3].flatten(1)
    apart = (position[:, None] - position).norm(dim=-1)
    # The trace of a relative rotation is 1 + 2 · cos(angle).
    cosine = (rotation @ rotation.T - 1) / 2
    near = (apart < NEAR_CM / 100) & (cosine > math.cos(math.radians(NEAR_DEG)))
    return near | torch.eye(len(pose), dtype=torch.bool)


def visible_cells(cameras: Cameras, cells: Tensor) -> Tensor:
    """Return whether each camera has each point in its picture and within ``SIGHT``, ``(n, V)`` bool.

    Args:
        cameras: ``(n,)``.
        cells: ``(V, 3)`` points of the world, metres.
    """
    cells = cells.to(cameras.intrinsics)
    return cameras.sees(*cameras.project(cells)) & (torch.cdist(cameras.position, cells) < SIGHT)


def _cells(grid: VoxelGrid) -> Tensor:
    """Return the centres of the cells by which frames are compared, ``(V, 3)``."""
    x, y, z = (max(1, math.ceil(length / CELL)) for length in grid.extent)
    return VoxelGrid((x, y, z), grid.extent, grid.center).voxel_centers().reshape(-1, 3)


class RepeatedFrames:
    """Warns once if scans have fewer frames than are asked for, so that some frames are repeated.

    A repeated frame weighs twice, and results "with 96 frames" are then from fewer.
    """

    def __init__(self) -> None:
        self._has_warned = False

    def look(self, batch: SceneBatch) -> None:
        """Check the frames of another batch; held-out frames do not count."""
        for scene_id, frames in zip(batch.scene_id, batch.frame_id, strict=True):
            if not self._has_warned and len(set(frames)) < len(frames):
                self._has_warned = True
                _log.warning(
                    "scans have %d frames, fewer than the %d asked for: frames are repeated (in %s first)",
                    *(len(set(frames)), len(frames), scene_id),
                )
