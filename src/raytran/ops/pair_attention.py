# SPDX-License-Identifier: Apache-2.0
"""Ray-traced attention over a pair list as an operator of torch, out of ``torch.sparse`` products.

No score of a pair that no ray joins is ever computed. The softmax weights, ``H · P`` numbers, are all that is
kept for the backward pass. It needs no atomic addition: the sums over targets run along the rows of the pair
list in the target's order, those over sources along its rows in the source's order.

Tensors go in and out, and the shapes are known without running: ``torch.compile`` and ``torch.export`` pass
through it. Under autocast it computes in float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from raytran.ops.pairs import PairOrder
from raytran.ops.segment import row_of_pair, sampled_product, segment_max, segment_sum, sparse_product


def pair_attention(
    query: Tensor, key: Tensor, value: Tensor, by_target: PairOrder, by_source: PairOrder
) -> Tensor:
    """Let each target attend to its sources: ``ray_attention`` for float32 or float64 of one dtype."""
    return _attend(query, key, value, list(by_target), list(by_source))[0]


@torch.library.custom_op("raytran::pair_attention", mutates_args=())
def _attend(
    query: Tensor, key: Tensor, value: Tensor, by_target: Sequence[Tensor], by_source: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the result ``(T, H, D)`` and the softmax weights ``(H, P)``; orders are ``PairOrder``'s tensors.

    Heads are taken one by one, so that what is not kept is one head's size.
    """
    order = PairOrder(*by_target)
    scale = query.shape[2] ** -0.5
    row = row_of_pair(order)
    weights = query.new_empty(query.shape[1], row.shape[0])
    out = query.new_empty(query.shape)
    for head, weight in enumerate(weights):
        score = sampled_product(query[:, head] * scale, key[:, head], order)
        score.sub_(segment_max(score, order)[row]).exp_()
        torch.div(score, segment_sum(score, order)[row], out=weight)
        out[:, head] = sparse_product(weight, value[:, head], order)
    return out, weights


@torch.library.custom_op("raytran::pair_attention_backward", mutates_args=())
def _attend_backward(
    grad: Tensor,
    query: Tensor,
    key: Tensor,
    value: Tensor,
    weights: Tensor,
    by_target: Sequence[Tensor],
    by_source: Sequence[Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of query, key and value."""
    target_order, source_order = PairOrder(*by_target), PairOrder(*by_source)
    scale = query.shape[2] ** -0.5
    row, turn = row_of_pair(target_order), _place_in(target_order, source_order)
    d_query, d_key, d_value = (tensor.new_empty(tensor.shape) for tensor in (query, key, value))
    for head, weight in enumerate(weights):
        of_head = grad[:, head]
        d_value[:, head] = sparse_product(weight[turn], of_head, source_order)
        # The softmax's own gradient: w · (g - Σ w g), with g = ∂/∂w.
        d_score = sampled_product(of_head, value[:, head], target_order)
        d_score.sub_(segment_sum(weight * d_score, target_order)[row]).mul_(weight).mul_(scale)
        d_query[:, head] = sparse_product(d_score, key[:, head], target_order)
        d_key[:, head] = sparse_product(d_score[turn], query[:, head], source_order)
    return d_query, d_key, d_value


def _place_in(order: PairOrder, wanted: PairOrder) -> Tensor:
    """Return ``(P,)`` such that ``values[place]`` brings values from ``order`` into ``wanted``."""
    place = torch.empty_like(order.permutation)
    place[order.permutation] = torch.arange(place.shape[0], device=place.device)
    return place[wanted.permutation]


@_attend.register_fake
def _(
    query: Tensor, key: Tensor, value: Tensor, by_target: Sequence[Tensor], *_: Any
) -> tuple[Tensor, Tensor]:
    return query.new_empty(query.shape), query.new_empty(query.shape[1], by_target[1].shape[0])


@_attend_backward.register_fake
def _(grad: Tensor, query: Tensor, key: Tensor, value: Tensor, *_: Any) -> tuple[Tensor, Tensor, Tensor]:
    return query.new_empty(query.shape), key.new_empty(key.shape), value.new_empty(value.shape)


def _keep(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    query, key, value, by_target, by_source = inputs
    ctx.save_for_backward(query, key, value, output[1], *by_target, *by_source)


def _gradients(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Any, ...]:
    saved = list(ctx.saved_tensors)
    return *_attend_backward(grad, *saved[:4], saved[4:7], saved[7:]), [None] * 3, [None] * 3


_attend.register_autograd(_gradients, setup_context=_keep)
for _operator in (_attend, _attend_backward):
    for _device in ("cpu", "cuda"):
        _operator.register_autocast(_device, torch.float32)
