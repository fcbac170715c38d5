# SPDX-License-Identifier: Apache-2.0
"""How all benchmarks take time and memory: the candidates in turn, round after round, the median of each."""

from __future__ import annotations

import os
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from device import Device, Run, this_device
from torch import Tensor
from torch.utils._pytree import tree_leaves

MEBIBYTE = 1 << 20


@dataclass
class Taken:
    """What one candidate took.

    Attributes:
        seconds: as called, until the device is done.
        alone: on the device alone; None where there is no such time.
        peak: most bytes over those held before, what it returns among them.
        returned: bytes of the tensors that it returns.
        error: why it does not run, one line; "" if it does.
    """

    seconds: float | None = None
    alone: float | None = None
    peak: int | None = None
    returned: int = 0
    error: str = ""

    @property
    def extra(self) -> int | None:
        """Bytes beyond what was held before and what is returned."""
        return None if self.peak is None else self.peak - self.returned


def median_seconds(
    candidates: Mapping[str, Run], rounds: int, clock: Callable[[], float] | None = None
) -> dict[str, float]:
    """Run every candidate once to warm up, then ``rounds`` times in turn; return the medians in seconds."""
    clock = clock or this_device().clock
    for run in candidates.values():
        run()
    return {name: statistics.median(seconds) for name, seconds in _in_turn(candidates, rounds, clock).items()}


def _in_turn(
    candidates: Mapping[str, Run], rounds: int, clock: Callable[[], float]
) -> dict[str, list[float]]:
    taken: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(rounds):
        for name, run in candidates.items():
            start = clock()
            run()
            taken[name].append(clock() - start)
    return taken


def measure(
    candidates: Mapping[str, Run],
    rounds: int,
    device: Device,
    *,
    clock: Callable[[], float] | None = None,
    alone: bool = False,
) -> dict[str, Taken]:
    """Take memory and time of each candidate; one that fails is said to and stops no other.

    Args:
        candidates: what to run, by name.
        rounds: how often.
        device: on which it runs.
        clock: seconds; by default that of the device.
        alone: take the time on the device alone too.
    """
    taken = {name: attempted(partial(_memory, run, device)) for name, run in candidates.items()}
    running = {
        name: partial(_run_unless_failed, run, taken[name])
        for name, run in candidates.items()
        if not taken[name].error
    }
    seconds = {
        name: statistics.median(found)
        for name, found in _in_turn(running, rounds, clock or device.clock).items()
    }
    by_device = device.alone_seconds(running, rounds) if alone else {}
    for name in running:
        if not taken[name].error:
            taken[name].seconds, taken[name].alone = seconds[name], by_device.get(name)
    return taken


def _run_unless_failed(run: Run, taken: Taken) -> None:
    if not taken.error:
        try:
            run()
        except Exception as error:
            taken.error = reason(error)


def attempted(run: Callable[[], Taken]) -> Taken:
    """Return what ``run`` does, or why it cannot: out of memory, not supported, wrong."""
    try:
        return run()
    except Exception as error:  # whatever it is, it ends one row
        return Taken(error=reason(error))


def reason(error: BaseException) -> str:
    """Return an exception, or the one that it comes from, as one line."""
    while error.__cause__ is not None:
        error = error.__cause__
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def _memory(run: Run, device: Device) -> Taken:
    run()  # what is made once and kept is not part of it
    held = device.held()
    out = run()
    returned = {tensor.data_ptr(): tensor.nbytes for tensor in tensors_in(out)}
    return Taken(peak=device.peak() - held, returned=sum(returned.values()))


def tensors_in(value: Any) -> list[Tensor]:
    """Return the tensors in nested lists and tuples."""
    return [leaf for leaf in tree_leaves(value) if isinstance(leaf, Tensor)]


def print_machine() -> None:
    """Print what the figures depend on."""
    gpu = f"{torch.cuda.get_device_name(0)}, " if torch.cuda.is_available() else ""
    print(
        f"{gpu}torch {torch.__version__}, {torch.get_num_threads()} threads on {os.cpu_count()} CPUs",
        end=", ",
    )
    print(f"load average before the run {os.getloadavg()[0]:.1f}")
