# SPDX-License-Identifier: Apache-2.0
"""Ray-traced sparse attention between the pixels and voxels that a ray joins (RayTran §3.1).

No score of a pair that no ray joins is ever computed. The softmax weights, ``H · P`` floats, are all that is
kept for the backward pass. It needs no atomic addition: the sums over targets run along the rows of the pair
list in the target's order, those over sources along its rows in the source's order.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from raytran.errors import check_shape
from raytran.ops.pairs import PairList, PairOrder
from raytran.ops.segment import row_of_pair, sampled_product, segment_max, segment_sum, sparse_product

Direction = Literal["pixels_to_voxels", "voxels_to_pixels"]


def ray_attention(
    query: Tensor, key: Tensor, value: Tensor, pairs: PairList, direction: Direction = "pixels_to_voxels"
) -> Tensor:
    """Let each target attend to the sources that a ray joins it with.

    ``out[t] = Σ_s softmax_s(query[t]·key[s] / √D) value[s]`` over the sources s paired with t, in each head.
    Half-precision input is computed in float32.

    Args:
        query: ``(T, H, D)``; the targets are the voxels of ``pairs``, or its pixels.
        key: ``(S, H, D)``; the sources are the other side.
        value: ``(S, H, D)``.
        pairs: which target sees which source.
        direction: from the source to the target.

    Returns:
        ``(T, H, D)`` in the dtype of ``query``; zeros for a target with no pair.

    Raises:
        ShapeError: the numbers of targets or sources are not those of ``pairs``.
    """
    if direction not in ("pixels_to_voxels", "voxels_to_pixels"):
        raise ValueError(f"direction must be 'pixels_to_voxels' or 'voxels_to_pixels', got {direction!r}")
    to_voxels = direction == "pixels_to_voxels"
    targets, sources = (pairs.num_voxels, pairs.num_pixels)[:: 1 if to_voxels else -1]
    check_shape(query, f"{targets} H D", "query")
    check_shape(key, f"{sources} {query.shape[1]} {query.shape[2]}", "key")
    check_shape(value, f"{sources} {query.shape[1]} {query.shape[2]}", "value")
    dtype = torch.promote_types(query.dtype, torch.float32)
    by_target = pairs.by("voxels" if to_voxels else "pixels")
    by_source = pairs.by("pixels" if to_voxels else "voxels")
    with torch.autocast(query.device.type, enabled=False):
        out = _RayAttention.apply(query.to(dtype), key.to(dtype), value.to(dtype), by_target, by_source)
    return out.to(query.dtype)


class _RayAttention(torch.autograd.Function):
    """Heads are taken one by one, so that what is not kept is one head's size."""

    @staticmethod
    def forward(
        ctx: Any, query: Tensor, key: Tensor, value: Tensor, by_target: PairOrder, by_source: PairOrder
    ) -> Tensor:
        scale = query.shape[2] ** -0.5
        row = row_of_pair(by_target)
        weights = query.new_empty(query.shape[1], row.shape[0])
        out = torch.empty_like(query)
        for head, weight in enumerate(weights):
            score = sampled_product(query[:, head] * scale, key[:, head], by_target)
            score.sub_(segment_max(score, by_target)[row]).exp_()
            torch.div(score, segment_sum(score, by_target)[row], out=weight)
            out[:, head] = sparse_product(weight, value[:, head], by_target)
        ctx.save_for_backward(query, key, value, weights, *by_target, *by_source)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        query, key, value, weights, *orders = ctx.saved_tensors
        by_target, by_source = PairOrder(*orders[:3]), PairOrder(*orders[3:])
        scale = query.shape[2] ** -0.5
        row, turn = row_of_pair(by_target), _place_in(by_target, by_source)
        d_query, d_key, d_value = torch.empty_like(query), torch.empty_like(key), torch.empty_like(value)
        with torch.autocast(grad.device.type, enabled=False):
            for head, weight in enumerate(weights):
                of_head = grad[:, head]
                d_value[:, head] = sparse_product(weight[turn], of_head, by_source)
                # The softmax's own gradient: w · (g - Σ w g), with g = ∂/∂w.
                d_score = sampled_product(of_head, value[:, head], by_target)
                d_score.sub_(segment_sum(weight * d_score, by_target)[row]).mul_(weight).mul_(scale)
                d_query[:, head] = sparse_product(d_score, key[:, head], by_target)
                d_key[:, head] = sparse_product(d_score[turn], query[:, head], by_source)
        return d_query, d_key, d_value, None, None


def _place_in(order: PairOrder, wanted: PairOrder) -> Tensor:
    """Return ``(P,)`` such that ``values[place]`` brings values from ``order`` into ``wanted``."""
    place = torch.empty_like(order.permutation)
    place[order.permutation] = torch.arange(place.shape[0], device=place.device)
    return place[wanted.permutation]
