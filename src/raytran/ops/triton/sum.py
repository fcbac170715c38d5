# SPDX-License-Identifier: Apache-2.0
"""Sums along rays over block pairs as an operator of torch, in a Triton kernel; see ``block_attention``."""

from __future__ import annotations

from collections.abc import Sequence
from math import gcd
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from raytran.ops.triton.attention import Launch, layout_of
from raytran.ops.triton.attention_backward_kernels import merge_sums
from raytran.ops.triton.attention_kernels import (
    box_elements,
    load_elements,
    load_parts,
    part_offsets,
    store_sum,
)
from raytran.ops.triton.block_pairs import BlockPairs


def block_sum(features: Tensor, blocks: BlockPairs) -> Tensor:
    """Return the sum over each voxel of the features of its pixels: ``(num_pixels, C) -> (num_voxels, C)``.

    It is summed and returned in float32.
    """
    by_voxel, by_pixel = blocks.by("voxels"), blocks.by("pixels")
    return _sum(
        features,
        blocks.masks,
        by_voxel.numbers,
        by_pixel.numbers,
        layout_of(blocks.voxels, by_voxel),
        layout_of(blocks.pixels, by_pixel),
        blocks.num_voxels,
    )


@torch.library.custom_op("raytran::block_sum", mutates_args=())
def _sum(
    source: Tensor,
    masks: Tensor,
    by_target: Tensor,
    by_source: Tensor,
    targets: Sequence[int],
    sources: Sequence[int],
    num_targets: int,
) -> Tensor:
    """Return the sum ``(T, C)`` float32 of the sources ``(S, C)`` that each target is joined with."""
    channels = source.shape[1]
    # Channels are taken in groups, as heads are.
    width = gcd(channels, 64) if channels % 16 == 0 else channels
    grouped = source.contiguous().view(source.shape[0], -1, width)
    out = source.new_empty((num_targets, *grouped.shape[1:]), dtype=torch.float32)
    launch = Launch(out, grouped, by_target, targets, sources)
    part = launch.scratch(width)
    with torch.cuda.device_of(source):
        sum_boxes[launch.grid](grouped, out, part, *launch.arguments(masks), num_warps=launch.num_warps)
        launch.merge(merge_sums, out, part)
    return out.view(num_targets, channels)


@triton.jit(do_not_specialize=["parts_at", "num_rows", "num_others"])
def sum_boxes(
    source_ptr: tl.tensor,
    out_ptr: tl.tensor,
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
    """Sum over each target of a row the sources it is joined with, for one group of channels."""
    item_ptr, head = order[0] + tl.program_id(0) // heads * 4, tl.program_id(0) % heads
    start, last, slot = tl.load(item_ptr), tl.load(item_ptr + 2), tl.load(item_ptr + 3)
    if start < 0:
        return
    offsets = part_offsets(OTHERS)
    summed = tl.zeros((32, WIDTH), tl.float32)
    for first in range(tl.load(item_ptr + 1), last, 8):
        source, exists, joined = load_parts(order, parts_at, first, last, offsets, num_others)
        feature = load_elements(source_ptr, source, exists, head, heads, DIM, WIDTH, OPERAND)
        summed = tl.dot(joined.to(OPERAND), feature, summed, input_precision="ieee")
    target, inside = box_elements(start, num_rows, ROWS)
    store_sum(out_ptr, part_ptr, summed, target, inside, slot, head, heads, DIM)


@_sum.register_fake
def _(source: Tensor, masks: Tensor, by_target: Tensor, *rest: Any) -> Tensor:
    return source.new_empty((rest[-1], source.shape[1]), dtype=torch.float32)


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    source, masks, by_target, by_source, *ctx.layout = inputs
    ctx.save_for_backward(masks, by_target, by_source)
    ctx.source = source.shape[0], source.dtype


def _gradients(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    masks, by_target, by_source = ctx.saved_tensors
    (number, dtype), (targets, sources, _) = ctx.source, ctx.layout
    back = _sum(grad, masks, by_source, by_target, sources, targets, number)
    return back.to(dtype), None, None, None, None, None, None


_sum.register_autograd(_gradients, setup_context=_keep)
