# SPDX-License-Identifier: Apache-2.0
"""Ray-traced attention over a pair list as an operator of torch, out of products of sparse matrices.

No score of a pair that no ray joins is ever computed. The exponentials of the scores, ``H · P`` numbers, are
all of the pairs' size that is kept for the backward pass. It needs no atomic addition: the sums over targets
run along the rows of the pair list in the target's order, those over sources along its rows in the source's
order. What can be done to targets is not done to pairs: the softmax's division, and the sum in its gradient.

Tensors go in and out, and the shapes are known without running: ``torch.compile`` and ``torch.export`` pass
through it. Under autocast it computes in float32.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from raytran.ops.pairs import PairOrder

with warnings.catch_warnings():
    # torch warns once per process that CSR tensors are in beta; what is used of them has tests of its own.
    warnings.simplefilter("ignore")
    torch.sparse_csr_tensor([0, 0], [], [], (1, 1))


_SPAN = 64.0
"""Scores that differ by less than this all keep their precision under one shift: e⁻⁶⁴ is 1.6e-28."""


def pair_attention(
    query: Tensor, key: Tensor, value: Tensor, by_target: PairOrder, by_source: PairOrder
) -> tuple[Tensor, Tensor]:
    """Let each target attend to its sources: ``ray_attention`` for tensors of one dtype of 32 or 64 bits.

    Returns:
        ``(T, H, D)``, and ``(T, H)`` the logarithm of the sum of each target's exponentials.
    """
    out, logsumexp, *_ = _attend(query, key, value, list(by_target), list(by_source))
    return out, logsumexp


@torch.library.custom_op("raytran::pair_attention", mutates_args=())
def _attend(
    query: Tensor, key: Tensor, value: Tensor, by_target: Sequence[Tensor], by_source: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the result ``(T, H, D)``, the log-sum-exp ``(T, H)``, and what the backward pass needs.

    That is the exponentials of the scores, shifted, ``(H, P)``, and their sums ``(T, H)``. Orders are
    ``PairOrder``'s tensors. Heads are taken one by one, so that what is not kept is one head's size.
    """
    order = PairOrder(*by_target)
    targets, heads, dim = query.shape
    out, logsumexp, sums = (
        query.new_empty(query.shape),
        query.new_empty(targets, heads),
        query.new_empty(targets, heads),
    )
    exponentials = query.new_empty(heads, order.col_index.shape[0])
    for head, exponential in enumerate(exponentials):
        score = sampled_product(query[:, head] * dim**-0.5, key[:, head].contiguous(), order)
        shift = _shift(score, order)
        shift_of_pair = shift.index_select(0, row_of_pair(order)) if shift.ndim else shift
        torch.exp(score.sub_(shift_of_pair), out=exponential)
        total = segment_sum(exponential, order)
        sums[:, head], logsumexp[:, head] = total, shift + total.log()
        summed = sparse_product(exponential, value[:, head].contiguous(), order)
        torch.mul(summed, _inverse(total)[:, None], out=out[:, head])
    return out, logsumexp, exponentials, sums


def _shift(score: Tensor, order: PairOrder) -> Tensor:
    """Return what to subtract from scores before their exponentials: one number, or one a row ``(R,)``."""
    if score.is_cpu and len(score):
        lowest, highest = score.aminmax()
        if highest - lowest < _SPAN:
            return highest
    return segment_max(score, order)


def _inverse(sums: Tensor) -> Tensor:
    """Return the reciprocal, and zero for the sum of nothing."""
    return sums.reciprocal().masked_fill_(sums == 0, 0.0)


@torch.library.custom_op("raytran::pair_attention_backward", mutates_args=())
def _attend_backward(
    grad: Tensor, saved: Sequence[Tensor], by_target: Sequence[Tensor], by_source: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of query, key and value; ``saved`` are these and what ``_attend`` returned."""
    query, key, value, out, exponentials, sums = saved
    target_order, source_order = PairOrder(*by_target), PairOrder(*by_source)
    scale = query.shape[2] ** -0.5
    row = row_of_pair(target_order)
    permutation = source_order.permutation
    inverse = _inverse(sums)
    # The softmax's own gradient: w · (g - Σ w g), with g = ∂/∂w; the sum is that of out · ∂out.
    mean = (grad * out).sum(dim=2).mul_(inverse)
    d_query, d_key, d_value = (tensor.new_empty(tensor.shape) for tensor in (query, key, value))
    for head, exponential in enumerate(exponentials):
        of_head = grad[:, head] * inverse[:, head, None]
        d_value[:, head] = sparse_product(exponential.index_select(0, permutation), of_head, source_order)
        d_score = sampled_product(of_head, value[:, head].contiguous(), target_order)
        d_score.sub_(mean[:, head].index_select(0, row)).mul_(exponential).mul_(scale)
        d_query[:, head] = sparse_product(d_score, key[:, head], target_order)
        d_key[:, head] = sparse_product(d_score.index_select(0, permutation), query[:, head], source_order)
    return d_query, d_key, d_value


@_attend.register_fake
def _(query: Tensor, key: Tensor, value: Tensor, by_target: Sequence[Tensor], *_: Any) -> tuple[Tensor, ...]:
    targets, heads, _dim = query.shape
    exponentials = query.new_empty(heads, by_target[1].shape[0])
    return (
        query.new_empty(query.shape),
        query.new_empty(targets, heads),
        exponentials,
        query.new_empty(targets, heads),
    )


@_attend_backward.register_fake
def _(grad: Tensor, saved: Sequence[Tensor], *_: Any) -> tuple[Tensor, ...]:
    return tuple(tensor.new_empty(tensor.shape) for tensor in saved[:3])


def _keep(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    query, key, value, by_target, by_source = inputs
    out, logsumexp, exponentials, sums = output
    ctx.mark_non_differentiable(logsumexp, exponentials, sums)
    ctx.save_for_backward(query, key, value, out, exponentials, sums, *by_target, *by_source)


def _gradients(ctx: Any, grad: Tensor, *_: Any) -> tuple[Any, ...]:
    saved = list(ctx.saved_tensors)
    return *_attend_backward(grad, saved[:6], saved[6:9], saved[9:]), [None] * 3, [None] * 3


_attend.register_autograd(_gradients, setup_context=_keep)
for _operator in (_attend, _attend_backward):
    for _device in ("cpu", "cuda"):
        _operator.register_autocast(_device, torch.float32)


# Sums over the rows of a pair order: the operations that all of the above is made of. A value per pair is a
# vector ``(P,)`` in the order of ``PairOrder.col_index``.


def row_of_pair(order: PairOrder) -> Tensor:
    """Return the row of each pair, ``(P,)`` int32."""
    counts = order.row_offsets.diff()
    rows = torch.arange(counts.shape[0], dtype=torch.int32, device=counts.device)
    return torch.repeat_interleave(rows, counts, output_size=order.col_index.shape[0])


def segment_sum(values: Tensor, order: PairOrder) -> Tensor:
    """Return the sum of ``values`` ``(P,)`` over each row, ``(rows,)``; zero for a row with no pair."""
    return torch.segment_reduce(values, "sum", offsets=order.row_offsets, initial=0, unsafe=True)


def segment_max(values: Tensor, order: PairOrder) -> Tensor:
    """Return the greatest of ``values`` ``(P,)`` in each row, ``(rows,)``; -inf for a row with no pair."""
    return torch.segment_reduce(values, "max", offsets=order.row_offsets, unsafe=True)


def sampled_product(rows: Tensor, cols: Tensor, order: PairOrder) -> Tensor:
    """Return the dot product of both sides of each pair: ``rows (R, D), cols (S, D) -> (P,)``."""
    values = rows.new_zeros(order.col_index.shape)
    matrix = _matrix(values, order, cols.shape[0])
    # Into the same matrix, or torch copies its indices too.
    torch.sparse.sampled_addmm(matrix, rows, cols.t(), beta=0.0, out=matrix)
    return values


def sparse_product(values: Tensor, cols: Tensor, order: PairOrder) -> Tensor:
    """Return the sum over each row of its pairs' columns times their values: ``(P,), (S, D) -> (R, D)``."""
    if cols.device.type == "cpu":
        # A sum of rows of a table by index, weighted: what embeddings of words are read with. Its loop is
        # compiled for the number of columns, and is several times faster than any product of torch.sparse.
        return F.embedding_bag(
            order.col_index,
            cols,
            order.row_offsets,
            mode="sum",
            per_sample_weights=values,
            include_last_offset=True,
        )
    return torch.sparse.mm(_matrix(values, order, cols.shape[0]), cols)


def _matrix(values: Tensor, order: PairOrder, num_cols: int) -> Tensor:
    size = (order.row_offsets.shape[0] - 1, num_cols)
    return torch.sparse_csr_tensor(order.row_offsets, order.col_index, values, size, check_invariants=False)
