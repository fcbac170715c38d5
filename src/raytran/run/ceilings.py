# SPDX-License-Identifier: Apache-2.0
"""How fast this machine multiplies and how fast it moves bytes, at best: measured, not looked up."""

from __future__ import annotations

import statistics
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


def measure_ceilings(device: torch.device, dtype: torch.dtype = torch.float32) -> Ceilings:
    """Measure both ceilings; takes about a second.

    Args:
        device: what to measure.
        dtype: of the matrix product.
    """
    side = 8192 if device.type == "cuda" else 1536
    length = 1 << (28 if device.type == "cuda" else 25)
    a, b = (torch.randn(side, side, device=device).to(dtype) for _ in range(2))
    source, target = (torch.zeros(length, device=device) for _ in range(2))
    return Ceilings(
        2 * side**3 / best_seconds(lambda: a @ b, device),
        2 * 4 * length / best_seconds(lambda: target.copy_(source), device),
    )


def best_seconds(run: Callable[[], object], device: torch.device, rounds: int = 5) -> float:
    """Return the shortest of some runs after one to warm up: what other work slows down is no ceiling."""
    return min(time_rounds(run, device, rounds))


def median_seconds(run: Callable[[], object], device: torch.device, rounds: int = 5) -> float:
    """Return the median of some runs after one to warm up."""
    return statistics.median(time_rounds(run, device, rounds))


def time_rounds(run: Callable[[], object], device: torch.device, rounds: int) -> list[float]:
    """Return the seconds of each run after one to warm up; a GPU's work is waited for."""
    seconds = []
    for number in range(rounds + 1):
        _wait(device)
        start = time.perf_counter()
        run()
        _wait(device)
        if number:
            seconds.append(time.perf_counter() - start)
    return seconds


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
