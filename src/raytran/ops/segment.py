# SPDX-License-Identifier: Apache-2.0
"""Sums over the rows of a pair order: the three operations that ray-traced attention is made of.

A value per pair is a vector ``(P,)`` in the order of ``PairOrder.col_index``.
"""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from raytran.ops.pairs import PairOrder

with warnings.catch_warnings():
    # torch warns once per process that CSR tensors are in beta; what is used of them has tests of its own.
    warnings.simplefilter("ignore")
    torch.sparse_csr_tensor([0, 0], [], [], (1, 1))


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
    matrix = _matrix(values, order, cols.shape[0])
    if cols.device.type == "cpu":
        # With a named reduction torch runs its own vectorised loop, several times faster than MKL's.
        return torch.sparse.mm(matrix, cols, "sum")
    return torch.sparse.mm(matrix, cols)


def _matrix(values: Tensor, order: PairOrder, num_cols: int) -> Tensor:
    size = (order.row_offsets.shape[0] - 1, num_cols)
    return torch.sparse_csr_tensor(order.row_offsets, order.col_index, values, size, check_invariants=False)
