# SPDX-License-Identifier: Apache-2.0
"""One layer of the DETR-style decoder: queries attend to each other and to the voxels (RayTran §3.2)."""

from __future__ import annotations

from collections.abc import Callable

import torch.nn.functional as F
from torch import Tensor, nn

from raytran.errors import ConfigError


class DecoderLayer(nn.Module):
    """Self-attention, attention to the voxels, feed-forward; normalisation comes before each.

    Args:
        channels: C of queries and voxels.
        num_heads: attention heads.
        hidden: channels inside the feed-forward.
        voxel_attention: called with ``channels`` and ``num_heads``, returns what queries read voxels with;
            None for ``VoxelAttention``, as in the paper.

    Raises:
        ConfigError: ``channels`` is not a multiple of ``num_heads``.
    """

    def __init__(
        self,
        *,
        channels: int,
        num_heads: int,
        hidden: int,
        voxel_attention: Callable[..., nn.Module] | None = None,
    ) -> None:
        super().__init__()
        if channels % num_heads:
            raise ConfigError(
                f"object head needs channels divisible by num_heads, got channels={channels}, "
                f"num_heads={num_heads}"
            )
        self.self_norm = nn.LayerNorm(channels)
        self.self_attention = nn.MultiheadAttention(channels, num_heads, batch_first=True)
        self.voxel_norm = nn.LayerNorm(channels)
        make_attention = VoxelAttention if voxel_attention is None else voxel_attention
        self.voxel_attention = make_attention(channels=channels, num_heads=num_heads)
        self.feed_forward = nn.Sequential(
            nn.LayerNorm(channels), nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, channels)
        )

    def forward(
        self,
        queries: Tensor,
        position: Tensor,
        reference: Tensor,
        memory: Tensor,
        voxel_position: Tensor,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Return the queries after the layer.

        Args:
            queries: ``(B, Q, C)``.
            position: ``(B, Q, C)`` code of the reference points.
            reference: ``(B, Q, 3)`` reference points, metres from the centre of the volume.
            memory: ``(B, V, C)`` voxel features with the code of their positions.
            voxel_position: ``(V, 3)`` voxel centres, metres from the centre of the volume.
            mask: ``(Q, Q)`` bool, True where the query of a row must not attend to that of a column.

        Returns:
            ``(B, Q, C)``.
        """
        x = self.self_norm(queries)
        located = x + position
        attended, _ = self.self_attention(located, located, x, need_weights=False, attn_mask=mask)
        queries = queries + attended
        located = self.voxel_norm(queries) + position
        queries = queries + self.voxel_attention(located, reference, memory, voxel_position)
        return queries + self.feed_forward(queries)


class VoxelAttention(nn.Module):
    """Multi-head attention to all voxels.

    Args:
        channels: C.
        num_heads: attention heads.
    """

    def __init__(self, *, channels: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(channels, channels, bias=False)  # a key bias cancels in the softmax
        self.value = nn.Linear(channels, channels)
        self.output = nn.Linear(channels, channels)

    def forward(self, queries: Tensor, reference: Tensor, memory: Tensor, voxel_position: Tensor) -> Tensor:
        """Return ``(B, Q, C)``; the arguments are those of ``DecoderLayer.forward``."""
        query = self._heads(self.query(queries))
        key = self._heads(self.key(memory))
        value = self._heads(self.value(memory))
        return self.output(F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2))

    def _heads(self, x: Tensor) -> Tensor:
        """Map ``(B, n, C)`` to ``(B, heads, n, D)``."""
        return x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)
