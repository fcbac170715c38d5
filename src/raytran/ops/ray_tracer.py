# SPDX-License-Identifier: Apache-2.0
"""Traversal on whatever device the cameras are on; on a GPU without making the host wait in training."""

from __future__ import annotations

import logging
from typing import NamedTuple

import torch
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.block_pairs import BlockPairs
from raytran.ops.fused import has_kernels
from raytran.ops.pairs import PairList
from raytran.ops.tiling import Tiling
from raytran.ops.traverse import trace_pairs

_log = logging.getLogger(__name__)

_ROOM_STEP = 1024
"""Room for block pairs is made in multiples of this, so that few sizes of memory come up."""


class _Reading(NamedTuple):
    """The number of block pairs of one call, on its way to the host."""

    number: Tensor
    arrived: torch.cuda.Event | None
    tiles: int
    capacity: int


class RayTracer:
    """Finds the pairs that rays join: a pair list, or block pairs where the fused kernels run.

    How many block pairs there are only the GPU knows. Where no gradients are asked for, the host waits for
    the number. In training there is room for ``headroom`` times as many a tile as have been met, and the true
    number is read once it has arrived. Should there have been more, a warning says how many were left out of
    that step (those of the last views), and later steps have room for them.

    Args:
        headroom: room for block pairs, as a multiple of the most that a tile has met on average.
    """

    def __init__(self, headroom: float = 1.5) -> None:
        self._headroom = headroom
        self._most_per_tile = 0.0
        self._readings: list[_Reading] = []

    @torch.compiler.disable
    def __call__(
        self, cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int
    ) -> PairList | BlockPairs:
        """Return the pairs of ``trace_pairs``, with both orders made; arguments and errors are its own."""
        if has_kernels(cameras.intrinsics.device):
            pairs: PairList | BlockPairs = self._trace_blocks(cameras, grid, feature_size, rays_per_cell)
        else:
            pairs = trace_pairs(cameras, grid, feature_size, rays_per_cell)
        # Their sizes depend on the data: better here than in code compiled for one size.
        pairs.by("pixels"), pairs.by("voxels")
        return pairs

    def _trace_blocks(
        self, cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int
    ) -> BlockPairs:
        # CPU installations of torch lack Triton: its module is imported only where it runs.
        from raytran.ops.trace_blocks import trace_blocks

        self._read()
        views = cameras.intrinsics.shape[:-2].numel()
        tiles = Tiling.of_pixels(views * feature_size[0] * feature_size[1], (views, *feature_size)).num_tiles
        capacity = None
        if torch.is_grad_enabled() and self._most_per_tile:
            capacity = -(-int(self._headroom * self._most_per_tile * tiles) // _ROOM_STEP) * _ROOM_STEP
        blocks, number = trace_blocks(cameras, grid, feature_size, rays_per_cell, capacity=capacity)
        if capacity is None:
            self._most_per_tile = max(self._most_per_tile, len(blocks) / tiles)
        else:
            self._readings.append(_send(number, tiles, capacity))
        return blocks

    def __getstate__(self) -> dict[str, object]:
        # A copy of a network, or one on its way to another process, does without what is still on its way.
        return {**self.__dict__, "_readings": []}

    def _read(self) -> None:
        """Take in the numbers that have arrived."""
        while self._readings and (self._readings[0].arrived is None or self._readings[0].arrived.query()):
            number, _, tiles, capacity = self._readings.pop(0)
            found = int(number)
            self._most_per_tile = max(self._most_per_tile, found / tiles)
            if found > capacity:
                _log.warning(
                    "%d of %d block pairs had no room in an earlier training step; later ones have",
                    found - capacity,
                    found,
                )


def _send(number: Tensor, tiles: int, capacity: int) -> _Reading:
    """Start to copy a number to the host."""
    if number.device.type != "cuda":
        return _Reading(number, None, tiles, capacity)
    on_host = torch.empty_like(number, device="cpu", pin_memory=True)
    on_host.copy_(number, non_blocking=True)
    arrived = torch.cuda.Event()
    arrived.record()
    return _Reading(on_host, arrived, tiles, capacity)
