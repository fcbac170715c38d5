# SPDX-License-Identifier: Apache-2.0
"""Operations and least bytes of each part of a training step, from its config alone.

The dense parts run on fake tensors, which have sizes and no data: torch's own counter sees every product and
convolution, forward and backward. What must cross the memory is counted alike: each product, convolution and
normalisation reads its inputs and writes its results once; everything between them could be fused and counts
nothing. What runs along the rays is counted by formula, because it depends on the number of pairs.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from raytran.model import RayTran
from raytran.ops.pairs import PairList
from raytran.run.plan.step_parts import Part

_MOVES_BYTES = (
    "convolution",
    "mm",
    "scaled_dot_product",
    "batch_norm",
    "layer_norm",
    "group_norm",
)
"""Parts of the names of torch's operations whose inputs and results must cross the memory."""


@dataclass(frozen=True)
class Work:
    """What a piece of a step costs on an ideal machine.

    Attributes:
        operations: floating-point additions and multiplications.
        bytes: to and from memory, at least.
    """

    operations: float
    bytes: float

    def __add__(self, other: Work) -> Work:
        return Work(self.operations + other.operations, self.bytes + other.bytes)

    def __mul__(self, times: float) -> Work:
        return Work(self.operations * times, self.bytes * times)

    def seconds(self, operations_per_second: float, bytes_per_second: float) -> float:
        """Return the least time on a machine with these two ceilings."""
        return max(self.operations / operations_per_second, self.bytes / bytes_per_second)


def count_part(
    part: Part, model: RayTran, pairs: PairList, *, element_bytes: int, training: bool = True
) -> Work:
    """Return the work of one run of a part.

    Args:
        part: of ``step_parts`` on fake tensors.
        model: the network that it belongs to.
        pairs: the pairs, of which only the numbers matter.
        element_bytes: of a feature, 2 in 16 bit.
        training: the backward pass too.
    """
    if part.over_pairs is None:
        return count_dense(part.run, training=training)
    channels = model.backbone.channels
    rows = (pairs.num_pixels + pairs.num_voxels) * channels * element_bytes
    if part.over_pairs == "traversal":
        # Each ray is cut by the planes of three axes; a pair is written as two integers.
        planes = sum(model.grid_resolution) * model.rays_per_cell**2 * pairs.num_pixels
        return Work(10.0 * planes, 16.0 * len(pairs))
    if part.over_pairs == "projection":
        return Work(0.0, 16.0 * len(pairs))
    if part.over_pairs == "splat":
        return Work(len(pairs) * channels, rows) * (2 if training else 1)
    # Forward: query, key, value, result; two products. Backward: query, key, value, result, its gradient, the
    # three gradients; five products, the scores again among them.
    forward = Work(4.0 * len(pairs) * channels, 2 * rows)
    return forward + Work(10.0 * len(pairs) * channels, 4 * rows) if training else forward


def count_dense(run: Callable[[], Tensor | None], *, training: bool = True) -> Work:
    """Return the work of a function whose tensors are all fake, or small."""
    flops, moved = FlopCounterMode(display=False), _BytesMoved()
    with moved, flops, nullcontext() if training else torch.no_grad():
        out = run()
        if training and out is not None:
            out.backward(torch.ones_like(out))
    return Work(flops.get_total_flops(), moved.bytes)


class _BytesMoved(TorchDispatchMode):
    """Adds up the sizes of what certain operations read and write."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        out = function(*args, **(kwargs or {}))
        if any(name in function.name() for name in _MOVES_BYTES):
            tensors = [x for x in tree_leaves((args, kwargs, out)) if isinstance(x, Tensor)]
            self.bytes += sum(x.numel() * x.element_size() for x in tensors)
        return out
