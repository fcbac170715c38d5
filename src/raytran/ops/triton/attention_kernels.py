# SPDX-License-Identifier: Apache-2.0
"""Triton kernels of ray-traced attention over block pairs; ``block_attention`` launches them.

A program takes one item of a ``BlockOrder`` and one head: a row, or a piece of a long row. It holds the row's
32 pixels or voxels and walks over the parts that the row touches on the other side, 8 parts of 8 elements a
step, with products of 32×64 on tensor cores and the masks' bits between them. Going forward the softmax is
taken online (Milakov & Gimelshein, 2018), so that no score leaves the chip; going backward the scores are
made again from the log-sum-exp (Dao et al., "FlashAttention", 2022): a pass along the targets' rows gives the
gradient of the queries, one along the sources' rows those of keys and values. No two programs write different
things to one place and the order of every sum is fixed, so that the same input gives the same bits.

A step is 2 products forward and 3 + 4 backward, of 2·32·64·D operations each. What bounds it are neither
products nor bytes but the instructions around them: with 32 channels in bfloat16 the code for an H200 has 840
of a warp a step forward, 950 and 1,100 backward. At the paper's size there are 5,100 steps along pixels and
6,900 along voxels for each of 8 heads, so forward and backward take 0.15 ms if all schedulers are busy; to
read the inputs and write the outputs takes 0.045 ms. Reckoned from the compiled code, not measured.

"Source" and "target" are those of the attention; in ``attend_backward_sources`` the rows are sources. ``DIM``
channels of a head are padded to a power of two, ``WIDTH``. Logarithms are to base 2. Arguments that belong
together are tuples: ``order`` is the numbers of a ``BlockOrder``, whose parts stand from ``parts_at`` on, and
the masks. ``ROWS`` and ``OTHERS`` are constants, the (box, part, grid) of a ``Tiling`` along its three axes,
the number of grids left out: a new number of views compiles nothing. Each is an argument of its own, and
numbers that may be 1 are in no tuple, because Triton before 3.8 loses constants that it passes on out of a
tuple.
"""

from __future__ import annotations

import triton
import triton.language as tl

LOG2_E = tl.constexpr(1.4426950408889634)


@triton.jit
def box_cells(slot: tl.tensor, TILE: tl.constexpr) -> tl.tuple:
    """Return where slots lie in a box along its three axes, as ``Tiling`` numbers them."""
    b_parts, c_parts = TILE[0][1] // TILE[1][1], TILE[0][2] // TILE[1][2]
    part, inner = slot // 8, slot % 8
    a = part // (b_parts * c_parts) * TILE[1][0] + inner // (TILE[1][1] * TILE[1][2])
    b = part // c_parts % b_parts * TILE[1][1] + inner // TILE[1][2] % TILE[1][1]
    return a, b, part % c_parts * TILE[1][2] + inner % TILE[1][2]


@triton.jit
def box_offsets(TILE: tl.constexpr) -> tl.tensor:
    """Return how many elements each slot of a box lies behind its first, ``(32,)``: ``Tiling.offset``."""
    a, b, c = box_cells(tl.arange(0, 32), TILE)
    return (a * TILE[2][1] + b) * TILE[2][2] + c


@triton.jit
def box_inside(start: tl.tensor, TILE: tl.constexpr) -> tl.tensor:
    """Return which slots of the box that begins at ``start`` are inside its grid, ``(32,)``."""
    a, b, c = box_cells(tl.arange(0, 32), TILE)
    a += start // (TILE[2][1] * TILE[2][2]) % TILE[2][0]
    b += start // TILE[2][2] % TILE[2][1]
    c += start % TILE[2][2]
    return (a < TILE[2][0]) & (b < TILE[2][1]) & (c < TILE[2][2])


@triton.jit
def box_elements(start: tl.tensor, number: tl.tensor, TILE: tl.constexpr) -> tl.tuple:
    """Return the elements of the box that begins at ``start``, ``(32,)``, and which of them exist."""
    element = start + box_offsets(TILE)
    return element, box_inside(start, TILE) & (element < number)


@triton.jit
def part_offsets(TILE: tl.constexpr) -> tl.tensor:
    """Return how many elements each slot of 8 parts lies behind its own part's first, ``(64,)``."""
    a, b, c = box_cells(tl.arange(0, 64) % 8, TILE)
    return (a * TILE[2][1] + b) * TILE[2][2] + c


@triton.jit
def load_parts(
    order: tl.tuple,
    parts_at: tl.tensor,
    first: tl.tensor,
    last: tl.tensor,
    offsets: tl.tensor,
    number: tl.tensor,
) -> tl.tuple:
    """Return the elements of 8 parts, ``(64,)``, whether they exist, and which are joined, ``(32, 64)``."""
    part = first + tl.arange(0, 64) // 8
    listed = part < last
    part_ptr = order[0] + parts_at + part * 2
    element = tl.load(part_ptr, mask=listed, other=0) + offsets
    place = tl.load(part_ptr + 1, mask=listed, other=0).to(tl.int64) * 8
    words = tl.load(order[1] + place + tl.arange(0, 64) % 8, mask=listed, other=0)
    joined = ((words[None, :] >> tl.arange(0, 32)[:, None]) & 1) != 0
    return element, listed & (element < number), joined


@triton.jit
def load_elements(
    ptr: tl.tensor,
    element: tl.tensor,
    exists: tl.tensor,
    head: tl.tensor,
    heads: tl.tensor,
    DIM: tl.constexpr,
    WIDTH: tl.constexpr,
    OPERAND: tl.constexpr,
) -> tl.tensor:
    """Return the channels of elements, ``(n, WIDTH)``, zero for those that do not exist."""
    channel = tl.arange(0, WIDTH)[None, :]
    at = (element.to(tl.int64) * heads + head)[:, None] * DIM + channel
    return tl.load(ptr + at, mask=exists[:, None] & (channel < DIM), other=0.0).to(OPERAND)


@triton.jit
def store_sum(
    out_ptr: tl.tensor,
    part_ptr: tl.tensor,
    summed: tl.tensor,
    element: tl.tensor,
    inside: tl.tensor,
    slot: tl.tensor,
    head: tl.tensor,
    heads: tl.tensor,
    DIM: tl.constexpr,
) -> None:
    """Write the sum of a row to its place in the result, that of a piece to a slot of scratch memory."""
    channel = tl.arange(0, summed.shape[1])[None, :]
    if slot < 0:
        at = (element.to(tl.int64) * heads + head)[:, None] * DIM + channel
        tl.store(out_ptr + at, summed.to(out_ptr.dtype.element_ty), mask=inside[:, None] & (channel < DIM))
    else:
        row = (slot * heads + head) * 32 + tl.arange(0, 32)[:, None]
        tl.store(part_ptr + row * DIM + channel, summed, mask=(row >= 0) & (channel < DIM))


@triton.jit(do_not_specialize=["parts_at", "num_rows", "num_others"])
def attend_forward(
    inputs: tl.tuple,
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
    """Give a row's targets the mean of the values they attend to, and the log-sum-exp of their scores."""
    scale: tl.constexpr = DIM**-0.5 * LOG2_E
    item_ptr, head = order[0] + tl.program_id(0) // heads * 4, tl.program_id(0) % heads
    start, last, slot = tl.load(item_ptr), tl.load(item_ptr + 2), tl.load(item_ptr + 3)
    if start < 0:
        return
    target, inside = box_elements(start, num_rows, ROWS)
    query = load_elements(inputs[0], target, inside, head, heads, DIM, WIDTH, OPERAND)
    offsets = part_offsets(OTHERS)
    peak = tl.full((32,), -float("inf"), tl.float32)
    total = tl.zeros((32,), tl.float32)
    summed = tl.zeros((32, WIDTH), tl.float32)
    for first in range(tl.load(item_ptr + 1), last, 8):
        source, exists, joined = load_parts(order, parts_at, first, last, offsets, num_others)
        key = load_elements(inputs[1], source, exists, head, heads, DIM, WIDTH, OPERAND)
        value = load_elements(inputs[2], source, exists, head, heads, DIM, WIDTH, OPERAND)
        score = tl.dot(query, tl.trans(key), input_precision="ieee")
        score = tl.where(joined, score, -float("inf"))
        higher = tl.maximum(peak, tl.max(score, axis=1) * scale)
        # A target that has met no source yet has no peak to subtract.
        shift = tl.where(higher == -float("inf"), 0.0, higher)
        weight = tl.exp2(tl.fma(score, scale, -shift[:, None]))
        fade = tl.exp2(peak - shift)
        total, peak = total * fade + tl.sum(weight, axis=1), higher
        weight = weight.to(inputs[2].dtype.element_ty).to(OPERAND)
        summed = tl.dot(weight, value, summed * fade[:, None], input_precision="ieee")
    _finish(outputs, parts, peak, total, summed, target, inside, slot, head, heads, DIM)


@triton.jit
def _finish(
    outputs: tl.tuple,
    parts: tl.tuple,
    peak: tl.tensor,
    total: tl.tensor,
    summed: tl.tensor,
    target: tl.tensor,
    inside: tl.tensor,
    slot: tl.tensor,
    head: tl.tensor,
    heads: tl.tensor,
    DIM: tl.constexpr,
) -> None:
    """Write the means of a row or piece, and the log-sum-exps; those of whole rows are +inf for nothing met.

    Then exp2(score - logsumexp), the weight of any source, is zero in the backward pass.
    """
    met = total > 0
    total = tl.where(met, total, 1.0)
    store_sum(outputs[0], parts[0], summed / total[:, None], target, inside, slot, head, heads, DIM)
    logsumexp = peak + tl.log2(total)
    if slot < 0:
        logsumexp = tl.where(met, logsumexp, float("inf"))
        tl.store(outputs[1] + target.to(tl.int64) * heads + head, logsumexp, mask=inside)
    else:
        tl.store(parts[1] + (slot * heads + head) * 32 + tl.arange(0, 32), logsumexp)


@triton.jit(do_not_specialize=["merges_at", "num_rows"])
def merge_forward(
    outputs: tl.tuple,
    parts: tl.tuple,
    order_ptr: tl.tensor,
    merges_at: tl.tensor,
    num_rows: tl.tensor,
    heads: tl.tensor,
    ROWS: tl.constexpr,
    DIM: tl.constexpr,
    WIDTH: tl.constexpr,
) -> None:
    """Join the pieces of a long row: the mean of their means, weighted by their sums."""
    merge_ptr, head = order_ptr + merges_at + tl.program_id(0) // heads * 3, tl.program_id(0) % heads
    start = tl.load(merge_ptr)
    if start < 0:
        return
    peak = tl.full((32,), -float("inf"), tl.float32)
    total = tl.zeros((32,), tl.float32)
    summed = tl.zeros((32, WIDTH), tl.float32)
    channel = tl.arange(0, WIDTH)[None, :]
    for slot in range(tl.load(merge_ptr + 1), tl.load(merge_ptr + 2)):
        row = (slot * heads + head) * 32 + tl.arange(0, 32)
        logsumexp = tl.load(parts[1] + row)
        mean = tl.load(parts[0] + row[:, None] * DIM + channel, mask=channel < DIM, other=0.0)
        higher = tl.maximum(peak, logsumexp)
        shift = tl.where(higher == -float("inf"), 0.0, higher)
        weight, fade = tl.exp2(logsumexp - shift), tl.exp2(peak - shift)
        total, peak = total * fade + weight, higher
        summed = summed * fade[:, None] + mean * weight[:, None]
    target, inside = box_elements(start, num_rows, ROWS)
    _finish(outputs, parts, peak, total, summed, target, inside, start * 0 - 1, head, heads, DIM)
