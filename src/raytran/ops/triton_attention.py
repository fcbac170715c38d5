# SPDX-License-Identifier: Apache-2.0
"""Triton kernels of ray-traced attention over block pairs; ``block_attention`` launches them.

A program takes one item of a ``BlockOrder`` and one head: a row of the block pairs, or a piece of a long row.
It holds the row's 32 pixels or 64 voxels and walks over the boxes that the row touches, with products of
32×64 on tensor cores and the mask's bits between them. Going forward the softmax is taken online (Milakov &
Gimelshein, 2018), so that no score leaves the chip; going backward the scores are made again from the
log-sum-exp (Dao et al., "FlashAttention", 2022): a pass along the targets' rows gives the gradient of the
queries, one along the sources' rows those of keys and values. No two programs write different things to one
place and the order of every sum is fixed, so that the same input gives the same bits.

Per block pair and head that is 2 products forward and 3 + 4 backward, of 2·32·64·D operations each, and the
mask's 256 bytes, which all heads share while the L2 cache holds them. What bounds it are neither bytes nor
products but the instructions around them, 13 an element forward: with 32 channels in bfloat16 the code for an
H200 takes 850 of a warp per block pair and head forward, 830 and 970 backward, and 12,500 block pairs of 8
heads 0.09 + 0.2 ms if all schedulers are busy (the bytes of inputs and outputs: 0.015 + 0.03 ms). Reckoned
from the compiled code, not measured.

``ROWS`` are the elements of a program's row: targets, or sources in ``attend_backward_sources``. ``DIM``
channels of a head are padded to a power of two, ``WIDTH``. Logarithms are to base 2. Arguments that belong
together are tuples: ``order`` is (source_start, place, items) of a ``BlockOrder`` and the masks; ``sizes`` is
(shape of the rows' grid, shape of the other grid, elements of either, heads).
"""

from __future__ import annotations

import triton
import triton.language as tl

LOG2_E = tl.constexpr(1.4426950408889634)


@triton.jit
def box_offsets(shape: tl.tuple, TILE: tl.constexpr) -> tl.tensor:
    """Return how many elements each slot of a box lies behind its first, ``(slots,)``: ``Tiling.offset``."""
    slot = tl.arange(0, TILE[0] * TILE[1] * TILE[2])
    a, b, c = slot // (TILE[1] * TILE[2]), slot // TILE[2] % TILE[1], slot % TILE[2]
    return (a * shape[1] + b) * shape[2] + c


@triton.jit
def box_inside(start: tl.tensor, shape: tl.tuple, TILE: tl.constexpr) -> tl.tensor:
    """Return which slots of the box that begins at ``start`` are inside its grid, ``(slots,)``."""
    slot = tl.arange(0, TILE[0] * TILE[1] * TILE[2])
    a = start // (shape[1] * shape[2]) % shape[0] + slot // (TILE[1] * TILE[2])
    b = start // shape[2] % shape[1] + slot // TILE[2] % TILE[1]
    c = start % shape[2] + slot % TILE[2]
    return (a < shape[0]) & (b < shape[1]) & (c < shape[2])


@triton.jit
def box_mask(masks_ptr: tl.tensor, place: tl.tensor, ROWS_ARE_VOXELS: tl.constexpr) -> tl.tensor:
    """Return which pairs of a pixel tile and a voxel block a ray joins, ``(64, 32)`` or ``(32, 64)``."""
    words = tl.load(masks_ptr + place.to(tl.int64) * 64 + tl.arange(0, 64))
    if ROWS_ARE_VOXELS:
        bits = words[:, None] >> tl.arange(0, 32)[None, :]
    else:
        bits = words[None, :] >> tl.arange(0, 32)[:, None]
    return (bits & 1) != 0


@triton.jit
def load_box(
    ptr: tl.tensor,
    start: tl.tensor,
    places: tl.tensor,
    there: tl.tensor,
    stride: tl.tensor,
    OPERAND: tl.constexpr,
) -> tl.tensor:
    """Return the channels of a box's elements, ``(slots, WIDTH)``, zero where nothing is."""
    box_ptr = ptr + start.to(tl.int64) * stride
    return tl.load(box_ptr + places, mask=there, other=0.0).to(OPERAND)


@triton.jit
def channel_places(
    offsets: tl.tensor, head: tl.tensor, heads: tl.tensor, DIM: tl.constexpr, WIDTH: tl.constexpr
) -> tl.tensor:
    """Return where a head's channels of a box's slots are behind the first slot, ``(slots, WIDTH)``."""
    return ((offsets * heads + head) * DIM)[:, None] + tl.arange(0, WIDTH)[None, :]


@triton.jit
def store_sum(
    out_ptr: tl.tensor,
    part_ptr: tl.tensor,
    summed: tl.tensor,
    start: tl.tensor,
    places: tl.tensor,
    there: tl.tensor,
    slot: tl.tensor,
    head: tl.tensor,
    heads: tl.tensor,
    DIM: tl.constexpr,
) -> None:
    """Write the sum of a row to its place in the result, that of a piece to a slot of scratch memory."""
    ROWS: tl.constexpr = summed.shape[0]
    if slot < 0:
        box_ptr = out_ptr + start.to(tl.int64) * heads * DIM
        tl.store(box_ptr + places, summed.to(out_ptr.dtype.element_ty), mask=there)
    else:
        row = (slot * heads + head) * ROWS + tl.arange(0, ROWS)
        channel = tl.arange(0, summed.shape[1])[None, :]
        tl.store(part_ptr + row[:, None] * DIM + channel, summed, mask=(row[:, None] >= 0) & (channel < DIM))


@triton.jit
def attend_forward(
    inputs: tl.tuple,
    outputs: tl.tuple,
    parts: tl.tuple,
    order: tl.tuple,
    sizes: tl.tuple,
    TILES: tl.constexpr,
    DIM: tl.constexpr,
    WIDTH: tl.constexpr,
    OPERAND: tl.constexpr,
) -> None:
    """Give a row's targets the mean of the values they attend to, and the log-sum-exp of their scores."""
    ROWS: tl.constexpr = TILES[0][0] * TILES[0][1] * TILES[0][2]
    scale: tl.constexpr = DIM**-0.5 * LOG2_E
    heads = sizes[4]
    item_ptr, head = order[2] + tl.program_id(0) // heads * 4, tl.program_id(0) % heads
    start, slot = tl.load(item_ptr), tl.load(item_ptr + 3)
    if start < 0:
        return
    is_channel = tl.arange(0, WIDTH)[None, :] < DIM
    offsets, inside = box_offsets(sizes[0], TILES[0]), box_inside(start, sizes[0], TILES[0])
    places, there = channel_places(offsets, head, heads, DIM, WIDTH), inside[:, None] & is_channel
    query = load_box(inputs[0], start, places, there, heads * DIM, OPERAND)
    others = box_offsets(sizes[1], TILES[1])
    other_places = channel_places(others, head, heads, DIM, WIDTH)
    peak = tl.full((ROWS,), -float("inf"), tl.float32)
    total = tl.zeros((ROWS,), tl.float32)
    summed = tl.zeros((ROWS, WIDTH), tl.float32)
    for pair in range(tl.load(item_ptr + 1), tl.load(item_ptr + 2)):
        source = tl.load(order[0] + pair)
        exists = (source + others < sizes[3])[:, None] & is_channel
        key = load_box(inputs[1], source, other_places, exists, heads * DIM, OPERAND)
        value = load_box(inputs[2], source, other_places, exists, heads * DIM, OPERAND)
        score = tl.dot(query, tl.trans(key), input_precision="ieee")
        score = tl.where(box_mask(order[3], tl.load(order[1] + pair), ROWS == 64), score, -float("inf"))
        higher = tl.maximum(peak, tl.max(score, axis=1) * scale)
        # A target that has met no source yet has no peak to subtract.
        shift = tl.where(higher == -float("inf"), 0.0, higher)
        weight = tl.exp2(tl.fma(score, scale, -shift[:, None]))
        fade = tl.exp2(peak - shift)
        total, peak = total * fade + tl.sum(weight, axis=1), higher
        weight = weight.to(inputs[2].dtype.element_ty).to(OPERAND)
        summed = tl.dot(weight, value, summed * fade[:, None], input_precision="ieee")
    _finish(
        outputs, parts, peak, total, summed, start, offsets, places, inside, there, slot, head, heads, DIM
    )


@triton.jit
def _finish(
    outputs: tl.tuple,
    parts: tl.tuple,
    peak: tl.tensor,
    total: tl.tensor,
    summed: tl.tensor,
    start: tl.tensor,
    offsets: tl.tensor,
    places: tl.tensor,
    inside: tl.tensor,
    there: tl.tensor,
    slot: tl.tensor,
    head: tl.tensor,
    heads: tl.tensor,
    DIM: tl.constexpr,
) -> None:
    """Write the means of a row or piece, and the log-sum-exps; those of whole rows are +inf for nothing met.

    Then exp2(score - logsumexp), the weight of any source, is zero in the backward pass.
    """
    ROWS: tl.constexpr = summed.shape[0]
    met = total > 0
    total = tl.where(met, total, 1.0)
    store_sum(outputs[0], parts[0], summed / total[:, None], start, places, there, slot, head, heads, DIM)
    if slot < 0:
        logsumexp = tl.where(met, peak + tl.log2(total), float("inf"))
        tl.store(outputs[1] + (start + offsets) * heads + head, logsumexp, mask=inside)
    else:
        row = (slot * heads + head) * ROWS + tl.arange(0, ROWS)
        tl.store(parts[1] + row, peak + tl.log2(total))


@triton.jit
def merge_forward(
    outputs: tl.tuple,
    parts: tl.tuple,
    merges_ptr: tl.tensor,
    shape: tl.tuple,
    heads: tl.tensor,
    TILE: tl.constexpr,
    DIM: tl.constexpr,
    WIDTH: tl.constexpr,
) -> None:
    """Join the pieces of a long row: the mean of their means, weighted by their sums."""
    ROWS: tl.constexpr = TILE[0] * TILE[1] * TILE[2]
    merge_ptr, head = merges_ptr + tl.program_id(0) // heads * 3, tl.program_id(0) % heads
    start = tl.load(merge_ptr)
    if start < 0:
        return
    peak = tl.full((ROWS,), -float("inf"), tl.float32)
    total = tl.zeros((ROWS,), tl.float32)
    summed = tl.zeros((ROWS, WIDTH), tl.float32)
    channel = tl.arange(0, WIDTH)[None, :]
    for slot in range(tl.load(merge_ptr + 1), tl.load(merge_ptr + 2)):
        row = (slot * heads + head) * ROWS + tl.arange(0, ROWS)
        logsumexp = tl.load(parts[1] + row)
        mean = tl.load(parts[0] + row[:, None] * DIM + channel, mask=channel < DIM, other=0.0)
        higher = tl.maximum(peak, logsumexp)
        shift = tl.where(higher == -float("inf"), 0.0, higher)
        weight, fade = tl.exp2(logsumexp - shift), tl.exp2(peak - shift)
        total, peak = total * fade + weight, higher
        summed = summed * fade[:, None] + mean * weight[:, None]
    offsets, inside = box_offsets(shape, TILE), box_inside(start, shape, TILE)
    places, there = channel_places(offsets, head, heads, DIM, WIDTH), inside[:, None] & (channel < DIM)
    whole = start * 0 - 1
    _finish(
        outputs, parts, peak, total, summed, start, offsets, places, inside, there, whole, head, heads, DIM
    )
