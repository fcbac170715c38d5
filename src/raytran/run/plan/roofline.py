# SPDX-License-Identifier: Apache-2.0
"""The least time that work takes on a device, by the roofline model (Williams, Waterman & Patterson, 2009).

Products run at the speed of a large product at best, bytes move at the speed of a large copy.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

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
class Ceilings:
    """What no program on a device exceeds.

    Attributes:
        operations_per_second: of a large matrix product; a multiplication and an addition are two.
        bytes_per_second: read and written by a large copy.
    """

    operations_per_second: float
    bytes_per_second: float


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

    def seconds(self, ceilings: Ceilings) -> float:
        """Return the least time that it takes."""
        return max(self.operations / ceilings.operations_per_second, self.bytes / ceilings.bytes_per_second)


def work_of_operation(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any], out: Any) -> Work:
    """Return the work of an operation of torch, by torch's own formulas for products and convolutions.

    Each product, convolution and normalisation reads its inputs and writes its results once; everything
    between them could be fused and counts nothing.

    Args:
        function: what a ``TorchDispatchMode`` is given.
        args: its arguments.
        kwargs: its arguments by name.
        out: its result.
    """
    count = flop_registry.get(function._overloadpacket)
    operations = 0 if count is None else count(*args, **kwargs, out_val=out)
    moved = 0
    if any(name in function.name() for name in _MOVES_BYTES):
        tensors = [leaf for leaf in tree_leaves((args, kwargs, out)) if isinstance(leaf, Tensor)]
        moved = sum(tensor.numel() * tensor.element_size() for tensor in tensors)
    return Work(operations, moved)


def work_of_attention(
    num_pairs: float, num_rows: int, channels: int, element_bytes: int, *, backward: bool
) -> Work:
    """Return the work of ray-traced attention.

    Forward it reads query, key and value, writes the result, and takes two products a pair. Backward it reads
    these and the result's gradient, writes three gradients, and takes five products, the scores again among
    them.

    Args:
        num_pairs: P.
        num_rows: targets and sources.
        channels: C of all heads.
        element_bytes: of a feature, 2 in 16 bit.
        backward: the backward pass, else the forward pass.
    """
    rows = num_rows * channels * element_bytes
    if backward:
        return Work(10.0 * num_pairs * channels, 4.0 * rows)
    return Work(4.0 * num_pairs * channels, 2.0 * rows)


def work_of_adamw(num_weights: int) -> Work:
    """Return the work of AdamW and the gradient's norm: 5 reads and 3 writes of 4 bytes a weight."""
    return Work(15.0 * num_weights, 32.0 * num_weights)


def measure_ceilings(
    device: torch.device,
    dtype: torch.dtype = torch.float32,
    clock: Callable[[], float] = time.perf_counter,
) -> Ceilings:
    """Measure both ceilings; takes about a second.

    Args:
        device: what to measure.
        dtype: of the matrix product.
        clock: seconds; that of the process on a CPU that others use too, with one thread.
    """
    side = 8192 if device.type == "cuda" else 1536
    length = 1 << (28 if device.type == "cuda" else 25)
    a, b = (torch.randn(side, side, device=device).to(dtype) for _ in range(2))
    source, target = (torch.zeros(length, device=device) for _ in range(2))
    return Ceilings(
        2 * side**3 / _best_seconds(lambda: a @ b, device, clock),
        2 * 4 * length / _best_seconds(lambda: target.copy_(source), device, clock),
    )


def _best_seconds(run: Callable[[], object], device: torch.device, clock: Callable[[], float]) -> float:
    """Return the shortest of five runs after one to warm up: what other work slows down is no ceiling."""
    seconds = []
    for _ in range(6):
        _wait(device)
        start = clock()
        run()
        _wait(device)
        seconds.append(clock() - start)
    return min(seconds[1:])


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
