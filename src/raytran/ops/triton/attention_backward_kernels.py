# SPDX-License-Identifier: Apache-2.0
"""Triton kernels of the backward pass; ``triton_attention`` explains the scheme, letters and arguments."""

from __future__ import annotations

import triton
import triton.language as tl

from raytran.ops.triton.attention_kernels import (
    LOG2_E,
    box_elements,
    load_elements,
    load_parts,
    part_offsets,
    store_sum,
)


@triton.jit(do_not_specialize=["parts_at", "num_rows", "num_others"])
def attend_backward_targets(
    inputs: tl.tuple,
    saved: tl.tuple,
    outputs: tl.tuple,
    part_ptr: tl.tensor,
    order: tl.tuple,
    parts_at: tl.tensor,
    num_rows: tl.tensor,
    num_others: tl.tensor,
    heads: tl.tensor,
    ROWS: tl.constexpr,
    OTHERS: tl.constexpr,
    DIM: tl.constexpr,
    WIDTH: tl.constexpr,
    OPERAND: tl.constexpr,
) -> None:
    """Make the gradient of a row's queries, and Σ_d out·∂out of its targets, which both passes need.

    ``inputs`` are query, key, value, out and the gradient of out; ``saved`` is the log-sum-exp and
    ``outputs`` are the gradient of the queries and that sum.
    """
    scale: tl.constexpr = DIM**-0.5
    item_ptr, head = order[0] + tl.program_id(0) // heads * 4, tl.program_id(0) % heads
    start, last, slot = tl.load(item_ptr), tl.load(item_ptr + 2), tl.load(item_ptr + 3)
    if start < 0:
        return
    target, inside = box_elements(start, num_rows, ROWS)
    query = load_elements(inputs[0], target, inside, head, heads, DIM, WIDTH, OPERAND)
    grad = load_elements(inputs[4], target, inside, head, heads, DIM, WIDTH, OPERAND)
    out = load_elements(inputs[3], target, inside, head, heads, DIM, WIDTH, tl.float32)
    delta = tl.sum(out * grad.to(tl.float32), axis=1)
    at = target.to(tl.int64) * heads + head
    # Every piece of a row writes the same.
    tl.store(outputs[1] + at, delta, mask=inside)
    logsumexp = tl.load(saved + at, mask=inside, other=float("inf"))
    offsets = part_offsets(OTHERS)
    summed = tl.zeros((32, WIDTH), tl.float32)
    for first in range(tl.load(item_ptr + 1), last, 8):
        source, exists, joined = load_parts(order, parts_at, first, last, offsets, num_others)
        key = load_elements(inputs[1], source, exists, head, heads, DIM, WIDTH, OPERAND)
        value = load_elements(inputs[2], source, exists, head, heads, DIM, WIDTH, OPERAND)
        score = tl.dot(query, tl.trans(key), input_precision="ieee")
        score = tl.where(joined, score, -float("inf"))
        d_weight = tl.dot(grad, tl.trans(value), input_precision="ieee")
        weight = tl.exp2(tl.fma(score, scale * LOG2_E, -logsumexp[:, None]))
        d_score = (weight * (d_weight - delta[:, None])).to(inputs[1].dtype.element_ty).to(OPERAND)
        summed = tl.dot(d_score, key, summed, input_precision="ieee")
    store_sum(outputs[0], part_ptr, summed * scale, target, inside, slot, head, heads, DIM)


@triton.jit(do_not_specialize=["parts_at", "num_rows", "num_others"])
def attend_backward_sources(
    inputs: tl.tuple,
    saved: tl.tuple,
    outputs: tl.tuple,
    parts: tl.tuple,
    order: tl.tuple,
    parts_at: tl.tensor,
    num_rows: tl.tensor,
    num_others: tl.tensor,
    heads: tl.tensor,
    ROWS: tl.constexpr,
    OTHERS: tl.constexpr,
    DIM: tl.constexpr,
    WIDTH: tl.constexpr,
    OPERAND: tl.constexpr,
) -> None:
    """Make the gradients of a row's keys and values; here the rows are sources.

    ``inputs`` are query, key, value, out and the gradient of out; ``saved`` are the log-sum-exp and the sum
    of ``attend_backward_targets``.
    """
    scale: tl.constexpr = DIM**-0.5
    item_ptr, head = order[0] + tl.program_id(0) // heads * 4, tl.program_id(0) % heads
    start, last, slot = tl.load(item_ptr), tl.load(item_ptr + 2), tl.load(item_ptr + 3)
    if start < 0:
        return
    source, inside = box_elements(start, num_rows, ROWS)
    key = load_elements(inputs[1], source, inside, head, heads, DIM, WIDTH, OPERAND)
    value = load_elements(inputs[2], source, inside, head, heads, DIM, WIDTH, OPERAND)
    offsets = part_offsets(OTHERS)
    d_key, d_value = tl.zeros((32, WIDTH), tl.float32), tl.zeros((32, WIDTH), tl.float32)
    for first in range(tl.load(item_ptr + 1), last, 8):
        target, exists, joined = load_parts(order, parts_at, first, last, offsets, num_others)
        query = load_elements(inputs[0], target, exists, head, heads, DIM, WIDTH, OPERAND)
        grad = load_elements(inputs[4], target, exists, head, heads, DIM, WIDTH, OPERAND)
        at = target.to(tl.int64) * heads + head
        logsumexp = tl.load(saved[0] + at, mask=exists, other=0.0)
        delta = tl.load(saved[1] + at, mask=exists, other=0.0)
        score = tl.dot(key, tl.trans(query), input_precision="ieee")
        score = tl.where(joined, score, -float("inf"))
        weight = tl.exp2(tl.fma(score, scale * LOG2_E, -logsumexp[None, :]))
        d_score = weight * (tl.dot(value, tl.trans(grad), input_precision="ieee") - delta[None, :])
        weight = weight.to(inputs[4].dtype.element_ty).to(OPERAND)
        d_value = tl.dot(weight, grad, d_value, input_precision="ieee")
        d_score = d_score.to(inputs[0].dtype.element_ty).to(OPERAND)
        d_key = tl.dot(d_score, query, d_key, input_precision="ieee")
    store_sum(outputs[0], parts[0], d_key * scale, source, inside, slot, head, heads, DIM)
    store_sum(outputs[1], parts[1], d_value, source, inside, slot, head, heads, DIM)


@triton.jit(do_not_specialize=["merges_at", "num_rows"])
def merge_sums(
    out_ptr: tl.tensor,
    part_ptr: tl.tensor,
    order_ptr: tl.tensor,
    merges_at: tl.tensor,
    num_rows: tl.tensor,
    heads: tl.tensor,
    ROWS: tl.constexpr,
    DIM: tl.constexpr,
    WIDTH: tl.constexpr,
) -> None:
    """Add up the pieces of a long row, in their order."""
    merge_ptr, head = order_ptr + merges_at + tl.program_id(0) // heads * 3, tl.program_id(0) % heads
    start = tl.load(merge_ptr)
    if start < 0:
        return
    channel = tl.arange(0, WIDTH)[None, :]
    summed = tl.zeros((32, WIDTH), tl.float32)
    for slot in range(tl.load(merge_ptr + 1), tl.load(merge_ptr + 2)):
        row = (slot * heads + head) * 32 + tl.arange(0, 32)
        summed += tl.load(part_ptr + row[:, None] * DIM + channel, mask=channel < DIM, other=0.0)
    element, inside = box_elements(start, num_rows, ROWS)
    store_sum(out_ptr, part_ptr, summed, element, inside, start * 0 - 1, head, heads, DIM)
