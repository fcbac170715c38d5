# SPDX-License-Identifier: Apache-2.0
"""Ray-traced attention over block pairs as an operator of torch, on the kernels of ``triton_attention``.

Needs Triton and a GPU, or Triton's interpreter (``TRITON_INTERPRET=1``), in which the kernels run anywhere,
slowly. The operator takes and gives tensors alone and knows its shapes without running, so that
``torch.compile`` and ``torch.export`` pass through it. Autocast leaves it alone: it multiplies in the dtype
that comes in and sums in float32.

Beyond inputs and outputs it needs the log-sum-exp of each target and head, going backward one more number of
the kind, and scratch memory of one size whatever the number of views: 512 rows of 32, with 8 heads of 32
channels 17 MB forward and 34 MB backward.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from raytran.ops.triton.attention_backward_kernels import (
    attend_backward_sources,
    attend_backward_targets,
    merge_sums,
)
from raytran.ops.triton.attention_kernels import attend_forward, merge_forward
from raytran.ops.triton.block_pairs import BlockOrder, BlockPairs
from raytran.ops.triton.tiling import ROW, Tiling

INTERPRETED = not isinstance(attend_forward, triton.JITFunction)

_OPERANDS = {torch.float16: tl.float16, torch.bfloat16: tl.bfloat16, torch.float32: tl.float32}


_LONGEST_RUN = 1 << 30
"""In place of the length of a run, so that runs of all lengths are one kernel."""


def warps_of(dtype: torch.dtype, width: int) -> int:
    """Return how many warps share a program that goes along a row of 32, for inputs of ``width`` channels.

    Tensor cores take 16 rows a warp, so that more than two warps would do everything twice; there are more
    where two had not enough registers. One choice for all GPUs, not one by measured time, which could differ
    between the ranks of a run. A test asks the compiler whether anything spills.
    """
    if dtype == torch.float32:
        return 4 if width <= 32 else 8
    return 2 if width <= 32 else 4


def block_attention(
    query: Tensor, key: Tensor, value: Tensor, blocks: BlockPairs, *, to_voxels: bool
) -> tuple[Tensor, Tensor]:
    """Let each target attend to its sources: ``ray_attention`` for tensors of one dtype of 16 or 32 bits.

    Returns:
        ``(T, H, D)``, and ``(T, H)`` float32 the logarithm to base 2 of the sum of a target's exponentials,
        +inf for a target with no pair.
    """
    sides = [(blocks.voxels, blocks.by("voxels")), (blocks.pixels, blocks.by("pixels"))]
    (targets, by_target), (sources, by_source) = sides if to_voxels else sides[::-1]
    return _attend(
        query,
        key,
        value,
        blocks.masks,
        by_target.numbers,
        by_source.numbers,
        layout_of(targets, by_target),
        layout_of(sources, by_source),
    )


def layout_of(tiling: Tiling, order: BlockOrder) -> list[int]:
    """Return the sizes of boxes, parts, a grid and an order as an operator takes them."""
    grid = (1, 1, _LONGEST_RUN) if tiling.is_run else tiling.shape[1:]
    return [*tiling.tile, *tiling.part, *grid, order.num_items, order.num_merges]


def constants_of(layout: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Return ``layout_of`` as the kernels take it: box, part, grid."""
    return tuple(layout[:3]), tuple(layout[3:6]), tuple(layout[6:9])


@torch.library.custom_op("raytran::block_attention", mutates_args=())
def _attend(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    masks: Tensor,
    by_target: Tensor,
    by_source: Tensor,
    targets: Sequence[int],
    sources: Sequence[int],
) -> tuple[Tensor, Tensor]:
    """Return the result ``(T, H, D)`` and the log-sum-exp ``(T, H)`` float32, as ``block_attention`` does."""
    query, key, value = query.contiguous(), key.contiguous(), value.contiguous()
    launch = Launch(query, key, by_target, targets, sources)
    outputs = torch.empty_like(query), query.new_empty(query.shape[:2], dtype=torch.float32)
    parts = launch.scratch(query.shape[2]), launch.scratch(1)
    with torch.cuda.device_of(query):
        attend_forward[launch.grid](
            (query, key, value), outputs, parts, *launch.arguments(masks), num_warps=launch.num_warps
        )
        launch.merge(merge_forward, outputs, parts)
    return outputs


@torch.library.custom_op("raytran::block_attention_backward", mutates_args=())
def _attend_backward(
    grad: Tensor,
    saved: Sequence[Tensor],
    masks: Tensor,
    by_target: Tensor,
    by_source: Tensor,
    targets: Sequence[int],
    sources: Sequence[int],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of query, key and value; ``saved`` are these, the result and its log-sum-exp."""
    query, key, value, out, logsumexp = (tensor.contiguous() for tensor in saved)
    inputs = query, key, value, out, grad.contiguous()
    d_query, d_key, d_value = torch.empty_like(query), torch.empty_like(key), torch.empty_like(value)
    delta = torch.empty_like(logsumexp)
    with torch.cuda.device_of(query):
        launch = Launch(query, key, by_target, targets, sources)
        part = launch.scratch(query.shape[2])
        arguments = launch.arguments(masks)
        attend_backward_targets[launch.grid](
            inputs, logsumexp, (d_query, delta), part, *arguments, num_warps=launch.num_warps
        )
        launch.merge(merge_sums, d_query, part)
        del part
        launch = Launch(key, query, by_source, sources, targets)
        parts = launch.scratch(query.shape[2]), launch.scratch(query.shape[2])
        arguments = launch.arguments(masks)
        attend_backward_sources[launch.grid](
            inputs, (logsumexp, delta), (d_key, d_value), parts, *arguments, num_warps=launch.num_warps
        )
        launch.merge(merge_sums, d_key, parts[0])
        launch.merge(merge_sums, d_value, parts[1])
    return d_query, d_key, d_value


class Launch:
    """What the kernels of one pass along rows are launched with.

    Args:
        row: ``(R, H, D)`` a tensor of the rows' side, targets or sources.
        other: ``(J, H, D)`` one of the other side, of the dtype that is multiplied in.
        order: numbers of the ``BlockOrder`` of the rows.
        rows: layout of the rows' grid and order.
        others: layout of the other grid.
    """

    def __init__(
        self,
        row: Tensor,
        other: Tensor,
        order: Tensor,
        rows: Sequence[int],
        others: Sequence[int],
    ) -> None:
        self._row, self._order = row, order
        self._num_rows, self._heads, self._dim = row.shape
        self._num_others, self._dtype = other.shape[0], other.dtype
        self._rows, self._others = constants_of(rows), constants_of(others)
        self._width = max(16, triton.next_power_of_2(self._dim))
        num_items, self._num_merges = rows[9:]
        self._merges_at = 4 * num_items
        self.grid = (num_items * self._heads,)
        self.num_warps = warps_of(self._dtype, self._width)

    def scratch(self, width: int) -> Tensor:
        """Return memory for the pieces of long rows."""
        return self._row.new_empty(2 * self._num_merges * ROW * self._heads * width, dtype=torch.float32)

    def arguments(self, masks: Tensor) -> tuple[Any, ...]:
        """Return the kernels' arguments from ``order`` on."""
        # The interpreter multiplies float32 alone rightly; elsewhere operands stay what they are.
        operand = tl.float32 if INTERPRETED else _OPERANDS[self._dtype]
        sizes = self._merges_at + 3 * self._num_merges, self._num_rows, self._num_others, self._heads
        return (self._order, masks), *sizes, self._rows, self._others, self._dim, self._width, operand

    def merge(self, kernel: Any, result: Any, parts: Any) -> None:
        """Put the pieces of long rows together."""
        if self._num_merges:
            sizes = self._merges_at, self._num_rows, self._heads
            kernel[self._num_merges * self._heads,](
                result, parts, self._order, *sizes, self._rows, self._dim, self._width
            )


@_attend.register_fake
def _(query: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    out = torch.empty_like(query, memory_format=torch.contiguous_format)
    return out, query.new_empty(query.shape[:2], dtype=torch.float32)


@_attend_backward.register_fake
def _(grad: Tensor, saved: Sequence[Tensor], *_: Any) -> tuple[Tensor, Tensor, Tensor]:
    query, key, value = (torch.empty_like(t, memory_format=torch.contiguous_format) for t in saved[:3])
    return query, key, value


def _keep(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    query, key, value, masks, by_target, by_source, *ctx.layout = inputs
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(query, key, value, *output, masks, by_target, by_source)


def _gradients(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Any, ...]:
    *saved, masks, by_target, by_source = ctx.saved_tensors
    gradients = _attend_backward(grad, saved, masks, by_target, by_source, *ctx.layout)
    return *gradients, None, None, None, None, None


_attend.register_autograd(_gradients, setup_context=_keep)
