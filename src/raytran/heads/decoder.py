# SPDX-License-Identifier: Apache-2.0
"""One layer of the DETR-style decoder: queries attend to each other and to the voxels (RayTran §3.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from raytran.errors import ConfigError
from raytran.norms import LayerNorm


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
                f"object head needs channels divisible by num_heads, got {channels} channels and {num_heads} "
                "heads: choose fewer heads"
            )
        self.self_norm = LayerNorm(channels)
        self.self_attention = SelfAttention(channels, num_heads, batch_first=True)
        self.voxel_norm = LayerNorm(channels)
        make_attention = VoxelAttention if voxel_attention is None else voxel_attention
        self.voxel_attention = make_attention(channels=channels, num_heads=num_heads)
        self.feed_forward = nn.Sequential(
            LayerNorm(channels), nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, channels)
        )

    def forward(
        self,
        queries: Tensor,
        position: Tensor,
        reference: Tensor,
        memory: Tensor | KeysAndValues,
        voxel_position: Tensor,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Return the queries after the layer.

        Args:
            queries: ``(B, Q, C)``, under autocast in its 16 bits, see ``in_product_dtype``.
            position: ``(B, Q, C)`` code of the reference points.
            reference: ``(B, Q, 3)`` reference points, metres from the centre of the volume.
            memory: ``(B, V, C)`` voxel features with the code of their positions, or for ``VoxelAttention``
                what ``keys_and_values_together`` made of them.
            voxel_position: ``(V, 3)`` voxel centres, metres from the centre of the volume.
            mask: ``(Q, Q)`` bool, True where the query of a row must not attend to that of a column.

        Returns:
            ``(B, Q, C)``.
        """
        x = self.self_norm(queries)
        queries = queries + self.self_attention(x + position, x, mask)
        located = self.voxel_norm(queries) + position
        queries = queries + self.voxel_attention(located, reference, memory, voxel_position)
        return queries + self.feed_forward(queries)


def in_product_dtype(x: Tensor) -> Tensor:
    """Return ``x`` as autocast's products take it.

    The decoder's stream is cast where it begins: every product takes it as it is, and casts nothing back.
    """
    kind = x.device.type
    return x.to(torch.get_autocast_dtype(kind)) if torch.is_autocast_enabled(kind) else x


class SelfAttention(nn.MultiheadAttention):
    """Attention of the queries to each other, located by a code of their positions that values leave out."""

    def forward(self, located: Tensor, x: Tensor, mask: Tensor | None = None) -> Tensor:  # type: ignore[override]
        """Return ``(B, Q, C)``.

        Args:
            located: ``(B, Q, C)`` queries with the code of their positions.
            x: ``(B, Q, C)`` queries.
            mask: ``(Q, Q)`` bool, as in ``DecoderLayer.forward``.
        """
        if located.is_cpu:  # to the last bit as ever; there is nothing to gain
            return super().forward(located, located, x, need_weights=False, attn_mask=mask)[0]
        both = 2 * self.embed_dim  # queries and keys are made in one product
        (weight, of_values), (bias, of_value) = (
            parameter.split([both, self.embed_dim])
            for parameter in (cast("Tensor", self.in_proj_weight), self.in_proj_bias)
        )
        query, key = F.linear(located, weight, bias).unflatten(-1, (2, self.num_heads, -1)).unbind(2)
        value = F.linear(x, of_values, of_value).unflatten(-1, (self.num_heads, -1))
        query, key, value = (part.transpose(1, 2) for part in (query, key, value))
        allowed = None if mask is None else ~mask
        attended = F.scaled_dot_product_attention(query, key, value, attn_mask=allowed)
        return self.out_proj(attended.transpose(1, 2).flatten(2))


KeysAndValues = tuple[Tensor, Tensor]
"""Keys and values of the voxels, each ``(B, V, C)``."""


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

    def forward(
        self, queries: Tensor, reference: Tensor, memory: Tensor | KeysAndValues, voxel_position: Tensor
    ) -> Tensor:
        """Return ``(B, Q, C)``; the arguments are those of ``DecoderLayer.forward``."""
        made = (self.key(memory), self.value(memory)) if isinstance(memory, Tensor) else memory
        query = self._heads(self.query(queries))
        key, value = map(self._heads, made)
        return self.output(F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2))

    def _heads(self, x: Tensor) -> Tensor:
        """Map ``(B, n, C)`` to ``(B, heads, n, D)``."""
        return x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)


def keys_and_values_together(
    attentions: Sequence[VoxelAttention], memory: Tensor
) -> tuple[KeysAndValues, ...]:
    """Return the keys and values that each attention makes of ``memory`` ``(B, V, C)``, in two products.

    All are in memory at once, as in training they are in any case.
    """
    key, value = (torch.cat([getattr(one, name).weight for one in attentions]) for name in ("key", "value"))
    bias = torch.cat([one.value.bias for one in attentions])
    made = F.linear(memory, key), F.linear(memory, value, bias)
    keys, values = (of_all.unflatten(-1, (len(attentions), -1)).unbind(-2) for of_all in made)
    return tuple(zip(keys, values, strict=True))
