# SPDX-License-Identifier: Apache-2.0
"""Queries made of noisy true objects, which the decoder learns to correct (DN-DETR, Li et al., CVPR 2022).

They need no matching: each says from the first step on what it should have become. In training alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import yaw_from_rotation
from raytran.heads.queries import QUERY_SCALE, Queries
from raytran.structs import CLASSES, ObjectSet

CENTER_NOISE = 0.5
"""Largest shift of a centre, as a multiple of the object's size along each of its axes: it stays inside."""

SIZE_NOISE, YAW_NOISE = 0.4, 0.5
"""Largest change of the logarithm of the size, and of the yaw in radians."""

WRONG_CLASS = 0.2
"""Probability that a copy is told a random class."""


class NoisyCopies(nn.Module):
    """Makes queries of the true objects of each scene: slot i is a copy of object i modulo M.

    A copy's embedding is that of its class, its reference point lies near the object's centre. Where queries
    are proposed, size and yaw start near the true ones too, as a proposal's do; learned queries start from
    the same size and yaw everywhere, and so do copies beside them.

    Args:
        channels: C.
        num_copies: D of each scene; if it has more objects the last ones get none.
    """

    def __init__(self, *, channels: int, num_copies: int) -> None:
        super().__init__()
        self.num_copies = num_copies
        self.embedding = nn.Parameter(QUERY_SCALE * torch.randn(len(CLASSES), channels))

    @torch.compiler.disable
    def forward(self, known: Sequence[ObjectSet], start: Queries, grid: VoxelGrid) -> Queries:
        """Return D queries for each of B scenes; those of a scene without objects stand in its middle.

        Args:
            known: true objects of the scenes.
            start: the other queries.
            grid: the voxel grids, ``center`` ``(B, 3)``.
        """
        center = grid.center.to(start.reference.dtype)
        copies = [
            self._copy(objects.to(center.device), middle)
            for objects, middle in zip(known, center, strict=True)
        ]
        label, place, log_size, yaw = (torch.stack(values) for values in zip(*copies, strict=True))
        shape = label.shape
        told = torch.where(
            torch.rand(shape, device=label.device) < WRONG_CLASS,
            torch.randint(len(CLASSES), shape, device=label.device),
            label,
        )
        if start.proposals is None:
            log_size = start.log_size[:, :1].expand_as(log_size)
            yaw_vector = start.yaw_vector[:, :1].expand(*shape, 2)
        else:
            log_size = log_size + SIZE_NOISE * _noise(log_size)
            yaw = yaw + YAW_NOISE * _noise(yaw)
            yaw_vector = torch.stack([yaw.sin(), yaw.cos()], dim=-1)
        return Queries(self.embedding[told], place - center[:, None], log_size, yaw_vector, None)

    def _copy(self, objects: ObjectSet, middle: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return labels, noisy centres, logarithms of the sizes and yaws of D copies."""
        count = self.num_copies
        if not len(objects):
            return (
                torch.zeros(count, dtype=torch.int64, device=middle.device),
                middle.expand(count, 3),
                middle.new_zeros(count, 3),
                middle.new_zeros(count),
            )
        some = objects.select(copied_objects(len(objects), count, middle.device))
        shift = CENTER_NOISE * _noise(some.size) * some.size
        place = some.center + (some.rotation @ shift[..., None]).squeeze(-1)
        return some.label, place, some.size.log(), yaw_from_rotation(some.rotation)


def copied_objects(num_objects: int, num_copies: int, device: torch.device) -> Tensor:
    """Return which object each slot is a copy of, ``(D,)`` int64."""
    return torch.arange(num_copies, device=device) % num_objects


def join_queries(queries: Queries, copies: Queries) -> Queries:
    """Return both, the copies behind."""
    both = [torch.cat([getattr(queries, name), getattr(copies, name)], dim=1) for name in Queries._fields[:4]]
    return Queries(both[0], both[1], both[2], both[3], queries.proposals)


def attention_mask(num_queries: int, num_copies: int, device: torch.device) -> Tensor:
    """Return who must not attend to whom, ``(Q + D, Q + D)`` bool, rows attend to columns.

    Queries must not see the truth in the copies, nor may two copies of an object average their noise away: a
    copy attends to itself and to the queries.
    """
    total = num_queries + num_copies
    is_copy = torch.arange(total, device=device) >= num_queries
    return is_copy.expand(total, total) & ~torch.eye(total, dtype=torch.bool, device=device)


def _noise(like: Tensor) -> Tensor:
    """Return numbers between -1 and 1."""
    return 2 * torch.rand_like(like) - 1
