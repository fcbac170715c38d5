# SPDX-License-Identifier: Apache-2.0
"""How all benchmarks take time: the candidates in turn, round after round, and the median of each."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import torch


def median_seconds(
    candidates: Mapping[str, Callable[[], object]],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Run every candidate once to warm up, then ``rounds`` times in turn; return the medians in seconds."""
    taken: dict[str, list[float]] = {name: [] for name in candidates}
    for number in range(rounds + 1):
        for name, run in candidates.items():
            start = clock()
            run()
            if number:
                taken[name].append(clock() - start)
    return {name: statistics.median(seconds) for name, seconds in taken.items()}


def peak_mebibytes(run: Callable[[], object]) -> float:
    """Return by how much the memory of this process rises at most during ``run`` (Linux)."""
    Path("/proc/self/clear_refs").write_text("5")  # sets the high-water mark to what is held now
    before = _high_water()
    run()
    return (_high_water() - before) / 1024


def _high_water() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def print_machine() -> None:
    """Print what the figures depend on."""
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads on {os.cpu_count()} CPUs", end=", ")
    print(f"load average before the run {os.getloadavg()[0]:.1f}")
