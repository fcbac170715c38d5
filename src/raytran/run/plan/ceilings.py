# SPDX-License-Identifier: Apache-2.0
"""How fast this machine multiplies and how fast it moves bytes, at best: measured, not looked up."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Ceilings:
    """What no program on a device exceeds.

    Attributes:
        operations_per_second: of a large matrix product; a multiplication and an addition are two.
        bytes_per_second: read and written by a large copy.
    """

    operations_per_second: float
    bytes_per_second: float


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
