# SPDX-License-Identifier: Apache-2.0
"""Triton kernels that find the block pairs of rays and their masks; ``trace_blocks`` launches them.

Every test is a slab test: a ray is between two planes over an interval of depth, inside a box over the
intersection of three of them, and the box counts if that is longer than ``NUDGE`` (the rule of ``traverse``).
The rule is float64's. Since many GPUs compute float64 at 1/64 of the speed, tests are made in float32 first,
with a bound of their error, and again in float64 only where that leaves in doubt what counts: the result is
that of float64 to the last bit. The interval of a block contains those of its voxels, because their planes
are the same: no pair is lost by testing blocks first.

``rays`` are origins ``(views, 3)`` in voxels and slopes ``(pixels · r, 3)``, depths per voxel along the axes,
0 for a ray parallel to the axis' planes, r rays a pixel one after another; and the slopes in float32.
``TILE`` and ``BLOCK`` are the (box, part, grid) of the tilings of pixels and voxels, see ``attention``.
"""

from __future__ import annotations

import triton
import triton.language as tl

from raytran.ops.triton.attention_kernels import box_cells, box_inside, box_offsets

NEVER = tl.constexpr(1e30)
"""Depth that no ray reaches."""


@triton.jit
def _planes(
    rays: tl.tuple, start: tl.tensor, low: tl.tuple, high: tl.tuple, TILE: tl.constexpr, REAL: tl.constexpr
) -> tl.tuple:
    """Return how far the lower planes of boxes are from a tile's camera along the three axes, and the upper.

    Six of ``(1, n)``. As differences of near numbers they are taken in float64 in any case, once a box.
    Rounding keeps their sign: a camera nearer than ``NUDGE`` to a plane stands on it.
    """
    origin_ptr = rays[0] + start // (TILE[2][1] * TILE[2][2]) * 3
    x, y, z = tl.load(origin_ptr), tl.load(origin_ptr + 1), tl.load(origin_ptr + 2)
    return (
        (low[0].to(tl.float64)[None, :] - x).to(REAL),
        (low[1].to(tl.float64)[None, :] - y).to(REAL),
        (low[2].to(tl.float64)[None, :] - z).to(REAL),
        (high[0].to(tl.float64)[None, :] - x).to(REAL),
        (high[1].to(tl.float64)[None, :] - y).to(REAL),
        (high[2].to(tl.float64)[None, :] - z).to(REAL),
    )


@triton.jit
def _interval(
    slopes_ptr: tl.tensor,
    start: tl.tensor,
    number: tl.tensor,
    planes: tl.tuple,
    TILE: tl.constexpr,
    RAYS: tl.constexpr,
) -> tl.tuple:
    """Return between which depths the rays of that number of a tile's pixels are inside of boxes.

    It is computed in the dtype of slopes and planes. Beside it stands which rays there are.
    """
    ray = (start + box_offsets(TILE)).to(tl.int64) * RAYS + number
    there = box_inside(start, TILE)
    near = tl.zeros((ray.shape[0], planes[0].shape[1]), slopes_ptr.dtype.element_ty)
    far = near + NEVER
    for axis in tl.static_range(3):
        slope = tl.load(slopes_ptr + ray * 3 + axis, mask=there, other=0.0)[:, None]
        before, behind = planes[axis], planes[axis + 3]
        # A parallel ray is between the planes for ever or never; the lower belongs to the box.
        always = tl.where((before <= 0) & (behind > 0), -NEVER, NEVER)
        entry = tl.where(slope > 0, before, behind) * slope
        leave = tl.where(slope > 0, behind, before) * slope
        entry = tl.where(slope == 0, always, entry)
        leave = tl.where(slope == 0, NEVER, leave)
        # Nothing here is not a number, which tl.maximum and tl.minimum would look for.
        near, far = tl.where(entry > near, entry, near), tl.where(leave < far, leave, far)
    return near, far, there[:, None]


@triton.jit
def _crossed(
    rays: tl.tuple,
    start: tl.tensor,
    number: tl.tensor,
    planes: tl.tuple,
    TILE: tl.constexpr,
    RAYS: tl.constexpr,
    NUDGE: tl.constexpr,
) -> tl.tensor:
    """Return which boxes the rays of that number of a tile's pixels run through."""
    near, far, there = _interval(rays[1], start, number, planes, TILE, RAYS)
    return (near + tl.full((1,), NUDGE, tl.float64)[:, None] < far) & there


@triton.jit
def _surely_crossed(
    rays: tl.tuple,
    start: tl.tensor,
    number: tl.tensor,
    planes: tl.tuple,
    TILE: tl.constexpr,
    RAYS: tl.constexpr,
    NUDGE: tl.constexpr,
) -> tl.tuple:
    """Return what ``_crossed`` does as far as float32 can tell, and for which boxes it cannot.

    A depth is a product of two numbers that were rounded once each: it is off by 3 parts in 2²⁴ at most, and
    so are the largest of those at which the ray enters and the smallest at which it leaves. Their difference
    adds two roundings. 8 parts are allowed.
    """
    near, far, there = _interval(rays[2], start, number, planes, TILE, RAYS)
    length = far - near - NUDGE
    doubtful = tl.abs(length) <= (near + tl.abs(far)) * (8 * 2**-24) + 1e-30
    return (length > 0) & (doubtful == 0) & there, doubtful & there


@triton.jit
def _block_cell(block: tl.tensor, BLOCK: tl.constexpr) -> tl.tuple:
    """Return the first voxel of blocks of a scene, along the three axes."""
    b_blocks, c_blocks = tl.cdiv(BLOCK[2][1], BLOCK[0][1]), tl.cdiv(BLOCK[2][2], BLOCK[0][2])
    a, b = block // (b_blocks * c_blocks), block // c_blocks % b_blocks
    return a * BLOCK[0][0], b * BLOCK[0][1], block % c_blocks * BLOCK[0][2]


@triton.jit
def touch_blocks(
    rays: tl.tuple,
    starts_ptr: tl.tensor,
    touched_ptr: tl.tensor,
    num_blocks: tl.tensor,
    TILE: tl.constexpr,
    BLOCK: tl.constexpr,
    RAYS: tl.constexpr,
    BLOCKS: tl.constexpr,
    NUDGE: tl.constexpr,
) -> None:
    """Write for a pixel tile which of some voxel blocks of its scene its rays run through."""
    tile, block = tl.program_id(0), tl.program_id(1) * BLOCKS + tl.arange(0, BLOCKS)
    start = tl.load(starts_ptr + tile)
    a, b, c = _block_cell(block, BLOCK)
    high = (
        tl.minimum(a + BLOCK[0][0], BLOCK[2][0]),
        tl.minimum(b + BLOCK[0][1], BLOCK[2][1]),
        tl.minimum(c + BLOCK[0][2], BLOCK[2][2]),
    )
    planes = _planes(rays, start, (a, b, c), high, TILE, tl.float32)
    touched = tl.zeros((BLOCKS,), tl.int32)
    doubt = tl.zeros((BLOCKS,), tl.int32)
    for number in range(RAYS):
        crossed, doubtful = _surely_crossed(rays, start, number, planes, TILE, RAYS, NUDGE)
        touched = tl.maximum(touched, tl.max(crossed.to(tl.int32), axis=0))
        doubt = tl.maximum(doubt, tl.max(doubtful.to(tl.int32), axis=0))
    if tl.max(doubt - touched, axis=0) > 0:
        exact = _planes(rays, start, (a, b, c), high, TILE, tl.float64)
        for number in range(RAYS):
            crossed = _crossed(rays, start, number, exact, TILE, RAYS, NUDGE)
            touched = tl.maximum(touched, tl.max(crossed.to(tl.int32), axis=0))
    at = tile.to(tl.int64) * num_blocks + block
    tl.store(touched_ptr + at, touched.to(tl.int8), mask=block < num_blocks)


@triton.jit(do_not_specialize=["capacity", "tiles_of_scene"])
def list_blocks(
    touched_ptr: tl.tensor,
    first_ptr: tl.tensor,
    keys_ptr: tl.tensor,
    capacity: tl.tensor,
    num_blocks: tl.tensor,
    tiles_of_scene: tl.tensor,
    all_blocks: tl.tensor,
    BLOCKS: tl.constexpr,
) -> None:
    """Write the keys of a tile's block pairs from their place ``first`` on, as far as there is room."""
    tile = tl.program_id(0)
    place = tl.load(first_ptr + tile)
    for chunk in range(0, num_blocks, BLOCKS):
        block = chunk + tl.arange(0, BLOCKS)
        at = tile.to(tl.int64) * num_blocks + block
        touched = tl.load(touched_ptr + at, mask=block < num_blocks, other=0).to(tl.int32)
        to = place + tl.cumsum(touched, axis=0) - touched
        key = tile.to(tl.int64) * all_blocks + tile // tiles_of_scene * num_blocks + block
        tl.store(keys_ptr + to, key, mask=(touched > 0) & (to < capacity))
        place += tl.sum(touched, axis=0)


@triton.jit(do_not_specialize=["num_tiles"])
def mask_blocks(
    rays: tl.tuple,
    starts_ptr: tl.tensor,
    keys_ptr: tl.tensor,
    masks_ptr: tl.tensor,
    num_tiles: tl.tensor,
    num_blocks: tl.tensor,
    all_blocks: tl.tensor,
    TILE: tl.constexpr,
    BLOCK: tl.constexpr,
    RAYS: tl.constexpr,
    NUDGE: tl.constexpr,
) -> None:
    """Write the masks of a block pair: which of its pixels' rays run through which of its voxels."""
    pair, slot = tl.program_id(0), tl.arange(0, 32)
    key = tl.load(keys_ptr + pair)
    tile = key // all_blocks
    crossed = tl.zeros((32, 32), tl.int32)
    if tile < num_tiles:
        start = tl.load(starts_ptr + tile)
        block = (key % all_blocks % num_blocks).to(tl.int32)
        first, cell = _block_cell(block, BLOCK), box_cells(slot, BLOCK)
        low = (first[0] + cell[0], first[1] + cell[1], first[2] + cell[2])
        high = (low[0] + 1, low[1] + 1, low[2] + 1)
        planes = _planes(rays, start, low, high, TILE, tl.float32)
        doubt = tl.zeros((32, 32), tl.int32)
        for number in range(RAYS):
            found, doubtful = _surely_crossed(rays, start, number, planes, TILE, RAYS, NUDGE)
            crossed, doubt = crossed | found.to(tl.int32), doubt | doubtful.to(tl.int32)
        if tl.max(tl.max(doubt - crossed, axis=0), axis=0) > 0:
            exact = _planes(rays, start, low, high, TILE, tl.float64)
            for number in range(RAYS):
                found = _crossed(rays, start, number, exact, TILE, RAYS, NUDGE)
                crossed = crossed | found.to(tl.int32)
        inside = (low[0] < BLOCK[2][0]) & (low[1] < BLOCK[2][1]) & (low[2] < BLOCK[2][2])
        crossed = tl.where(inside[None, :], crossed, 0)
    mask_ptr = masks_ptr + pair.to(tl.int64) * 64 + slot
    tl.store(mask_ptr, tl.sum(crossed << slot[:, None], axis=0))
    tl.store(mask_ptr + 32, tl.sum(crossed << slot[None, :], axis=1))
