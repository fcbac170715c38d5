# SPDX-License-Identifier: Apache-2.0
"""Look on while a network runs: what the voxels of the last block ask for, and what the pixels answer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from raytran.backbone.block import RayTracedBlock
from raytran.errors import ShapeError


@dataclass
class ObservedAttention:
    """The last block's 2D→3D attention, on the CPU; filled while the network runs.

    Attributes:
        num_heads: H.
        queries: one tensor ``(V, H, D)`` for each run of the network, V voxels of all scenes.
        keys: one tensor ``(n, H, D)`` for each run, or for each chunk of views, n pixels of all scenes.
    """

    num_heads: int
    queries: list[Tensor] = field(default_factory=list)
    keys: list[Tensor] = field(default_factory=list)

    def runs(self, num_pixels: Sequence[int]) -> list[tuple[Tensor, Tensor]]:
        """Return the query ``(V, H, D)`` and key ``(n, H, D)`` of each run of the network.

        Args:
            num_pixels: n of each run, over all views and scenes.

        Raises:
            ShapeError: it has not run so often, or on other numbers of pixels.
        """
        given = sum(len(key) for key in self.keys)
        if len(self.queries) != len(num_pixels) or given != sum(num_pixels):
            raise ShapeError(
                f"expected {len(num_pixels)} runs on {sum(num_pixels)} pixels, "
                f"observed {len(self.queries)} on {given}"
            )
        return list(zip(self.queries, torch.cat(self.keys).split(list(num_pixels)), strict=True))

    def _split(self, features: Tensor) -> Tensor:
        return features.detach().flatten(0, -2).unflatten(-1, (self.num_heads, -1)).cpu()


@contextmanager
def observe_attention(network: nn.Module) -> Iterator[ObservedAttention | None]:
    """Keep what the last ray-traced block compares while the block of this statement runs the network.

    It listens to two linear layers: outside the statement it costs nothing.

    Args:
        network: any module.

    Yields:
        the record, or None for a network without a ray-traced block.
    """
    blocks = [module for module in network.modules() if isinstance(module, RayTracedBlock)]
    if not blocks:
        yield None
        return
    stream = blocks[-1].voxel_stream
    record = ObservedAttention(stream.num_heads)

    handles = [
        layer.register_forward_hook(lambda _layer, _input, out, kept=kept: kept.append(record._split(out)))
        for layer, kept in ((stream.query, record.queries), (stream.key, record.keys))
    ]
    try:
        yield record
    finally:
        for handle in handles:
            handle.remove()
