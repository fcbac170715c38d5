# SPDX-License-Identifier: Apache-2.0
"""Triton kernels of the backward pass; ``triton_attention`` explains the scheme, letters and arguments."""

from __future__ import annotations

import triton
import triton.language as tl

from raytran.ops.triton_attention import (
    LOG2_E,
    box_inside,
    box_mask,
    box_offsets,
    channel_places,
    load_box,
    store_sum,
)


@triton.jit
def attend_backward_targets(
    inputs: tl.tuple,
    saved: tl.tuple,
    outputs: tl.tuple,
    part_ptr: tl.tensor,
    order: tl.tuple,
    sizes: tl.tuple,
    TILES: tl.constexpr,
    DIM: tl.constexpr,
    WIDTH: tl.constexpr,
    OPERAND: tl.constexpr,
) -> None:
    """Make the gradient of a row's queries, and Σ_d out·∂out of its targets, which both passes need.

    ``inputs`` are query, key, value, out and the gradient of out; ``saved`` is the log-sum-exp and
    ``outputs`` are the gradient of the queries and that sum.
    """
    ROWS: tl.constexpr = TILES[0][0] * TILES[0][1] * TILES[0][2]
    scale: tl.constexpr = DIM**-0.5
    heads = sizes[4]
    item_ptr, head = order[2] + tl.program_id(0) // heads * 4, tl.program_id(0) % heads
    start, slot = tl.load(item_ptr), tl.load(item_ptr + 3)
    if start < 0:
        return
    is_channel = tl.arange(0, WIDTH)[None, :] < DIM
    offsets, inside = box_offsets(sizes[0], TILES[0]), box_inside(start, sizes[0], TILES[0])
    places, there = channel_places(offsets, head, heads, DIM, WIDTH), inside[:, None] & is_channel
    query = load_box(inputs[0], start, places, there, heads * DIM, OPERAND)
    grad = load_box(inputs[4], start, places, there, heads * DIM, OPERAND)
    out = load_box(inputs[3], start, places, there, heads * DIM, tl.float32)
    delta = tl.sum(out * grad.to(tl.float32), axis=1)
    at = (start + offsets) * heads + head
    # Every piece of a row writes the same.
    tl.store(outputs[1] + at, delta, mask=inside)
    logsumexp = tl.load(saved + at, mask=inside, other=float("inf"))
    others = box_offsets(sizes[1], TILES[1])
    other_places = channel_places(others, head, heads, DIM, WIDTH)
    summed = tl.zeros((ROWS, WIDTH), tl.float32)
    for pair in range(tl.load(item_ptr + 1), tl.load(item_ptr + 2)):
        source = tl.load(order[0] + pair)
        exists = (source + others < sizes[3])[:, None] & is_channel
        key = load_box(inputs[1], source, other_places, exists, heads * DIM, OPERAND)
        value = load_box(inputs[2], source, other_places, exists, heads * DIM, OPERAND)
        score = tl.dot(query, tl.trans(key), input_precision="ieee")
        score = tl.where(box_mask(order[3], tl.load(order[1] + pair), ROWS == 64), score, -float("inf"))
        d_weight = tl.dot(grad, tl.trans(value), input_precision="ieee")
        d_score = tl.exp2(tl.fma(score, scale * LOG2_E, -logsumexp[:, None])) * (d_weight - delta[:, None])
        d_score = d_score.to(inputs[1].dtype.element_ty).to(OPERAND)
        summed = tl.dot(d_score, key, summed, input_precision="ieee")
    store_sum(outputs[0], part_ptr, summed * scale, start, places, there, slot, head, heads, DIM)


@triton.jit
def attend_backward_sources(
    inputs: tl.tuple,
    saved: tl.tuple,
    outputs: tl.tuple,
    parts: tl.tuple,
    order: tl.tuple,
    sizes: tl.tuple,
    TILES: tl.constexpr,
    DIM: tl.constexpr,
    WIDTH: tl.constexpr,
    OPERAND: tl.constexpr,
) -> None:
    """Make the gradients of a row's keys and values; here rows are sources and J are targets.

    ``inputs`` are query, key, value, out and the gradient of out; ``saved`` are the log-sum-exp and the sum
    of ``attend_backward_targets``; ``sizes`` and ``TILES`` name the rows' grid, the sources', first.
    """
    ROWS: tl.constexpr = TILES[0][0] * TILES[0][1] * TILES[0][2]
    scale: tl.constexpr = DIM**-0.5
    heads = sizes[4]
    item_ptr, head = order[2] + tl.program_id(0) // heads * 4, tl.program_id(0) % heads
    start, slot = tl.load(item_ptr), tl.load(item_ptr + 3)
    if start < 0:
        return
    is_channel = tl.arange(0, WIDTH)[None, :] < DIM
    offsets, inside = box_offsets(sizes[0], TILES[0]), box_inside(start, sizes[0], TILES[0])
    places, there = channel_places(offsets, head, heads, DIM, WIDTH), inside[:, None] & is_channel
    key = load_box(inputs[1], start, places, there, heads * DIM, OPERAND)
    value = load_box(inputs[2], start, places, there, heads * DIM, OPERAND)
    others = box_offsets(sizes[1], TILES[1])
    other_places = channel_places(others, head, heads, DIM, WIDTH)
    d_key, d_value = tl.zeros((ROWS, WIDTH), tl.float32), tl.zeros((ROWS, WIDTH), tl.float32)
    for pair in range(tl.load(item_ptr + 1), tl.load(item_ptr + 2)):
        target = tl.load(order[0] + pair)
        exists = target + others < sizes[3]
        query = load_box(inputs[0], target, other_places, exists[:, None] & is_channel, heads * DIM, OPERAND)
        grad = load_box(inputs[4], target, other_places, exists[:, None] & is_channel, heads * DIM, OPERAND)
        at = (target + others) * heads + head
        logsumexp = tl.load(saved[0] + at, mask=exists, other=0.0)
        delta = tl.load(saved[1] + at, mask=exists, other=0.0)
        score = tl.dot(key, tl.trans(query), input_precision="ieee")
        score = tl.where(box_mask(order[3], tl.load(order[1] + pair), ROWS == 64), score, -float("inf"))
        weight = tl.exp2(tl.fma(score, scale * LOG2_E, -logsumexp[None, :]))
        d_score = weight * (tl.dot(value, tl.trans(grad), input_precision="ieee") - delta[None, :])
        weight = weight.to(inputs[4].dtype.element_ty).to(OPERAND)
        d_value = tl.dot(weight, grad, d_value, input_precision="ieee")
        d_score = d_score.to(inputs[0].dtype.element_ty).to(OPERAND)
        d_key = tl.dot(d_score, query, d_key, input_precision="ieee")
    store_sum(outputs[0], parts[0], d_key * scale, start, places, there, slot, head, heads, DIM)
    store_sum(outputs[1], parts[1], d_value, start, places, there, slot, head, heads, DIM)


@triton.jit
def merge_sums(
    out_ptr: tl.tensor,
    part_ptr: tl.tensor,
    merges_ptr: tl.tensor,
    shape: tl.tuple,
    heads: tl.tensor,
    TILE: tl.constexpr,
    DIM: tl.constexpr,
    WIDTH: tl.constexpr,
) -> None:
    """Add up the pieces of a long row, in their order."""
    ROWS: tl.constexpr = TILE[0] * TILE[1] * TILE[2]
    merge_ptr, head = merges_ptr + tl.program_id(0) // heads * 3, tl.program_id(0) % heads
    start = tl.load(merge_ptr)
    if start < 0:
        return
    channel = tl.arange(0, WIDTH)[None, :]
    summed = tl.zeros((ROWS, WIDTH), tl.float32)
    for slot in range(tl.load(merge_ptr + 1), tl.load(merge_ptr + 2)):
        row = (slot * heads + head) * ROWS + tl.arange(0, ROWS)
        summed += tl.load(part_ptr + row[:, None] * DIM + channel, mask=channel < DIM, other=0.0)
    places = channel_places(box_offsets(shape, TILE), head, heads, DIM, WIDTH)
    there = box_inside(start, shape, TILE)[:, None] & (channel < DIM)
    whole = start * 0 - 1
    store_sum(out_ptr, part_ptr, summed, start, places, there, whole, head, heads, DIM)
