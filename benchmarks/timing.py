# SPDX-License-Identifier: Apache-2.0
"""How all benchmarks take time and memory: the candidates in turn, round after round, the median of each."""

from __future__ import annotations

import ctypes
import os
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import torch

MEBIBYTE = 1 << 20


def median_seconds(
    candidates: Mapping[str, Callable[[], object]],
    rounds: int,
    clock: Callable[[], float] | None = None,
) -> dict[str, float]:
    """Run every candidate once to warm up, then ``rounds`` times in turn; return the medians in seconds."""
    clock = clock or _clock
    taken: dict[str, list[float]] = {name: [] for name in candidates}
    for number in range(rounds + 1):
        for name, run in candidates.items():
            start = clock()
            run()
            if number:
                taken[name].append(clock() - start)
    return {name: statistics.median(seconds) for name, seconds in taken.items()}


def peak_mebibytes(run: Callable[[], object]) -> float:
    """Return by how much memory rises at most during ``run``: a GPU's tensors, else this process (Linux)."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        held = torch.cuda.memory_allocated()
        run()
        return (torch.cuda.max_memory_allocated() - held) / MEBIBYTE
    ctypes.CDLL(None).malloc_trim(0)  # gives back what was freed, or the next rise would go unseen
    Path("/proc/self/clear_refs").write_text("5")  # sets the high-water mark to what is held now
    before = _high_water()
    run()
    return (_high_water() - before) / 1024


def print_machine() -> None:
    """Print what the figures depend on."""
    gpu = f"{torch.cuda.get_device_name(0)}, " if torch.cuda.is_available() else ""
    print(
        f"{gpu}torch {torch.__version__}, {torch.get_num_threads()} threads on {os.cpu_count()} CPUs",
        end=", ",
    )
    print(f"load average before the run {os.getloadavg()[0]:.1f}")


def _clock() -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def _high_water() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
