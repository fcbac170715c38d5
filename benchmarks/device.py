# SPDX-License-Identifier: Apache-2.0
"""What the benchmarks ask of a device: its time, its memory, the waits of the host, what the Trainer needs.

The one place that talks to ``torch.cuda``, so that all else runs on the processor, and in a test on a device
that only pretends to be a GPU.
"""

from __future__ import annotations

import ctypes
import gc
import os
import statistics
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

import raytran

if TYPE_CHECKING:
    import lightning.pytorch as pl

    from raytran.ops.traverse import Attention

Run = Callable[[], object]


class Device:
    """The processor, and what a device is asked for.

    Attributes:
        torch_device: where tensors go.
        attention: ``model.attention`` by which networks run their kernels there.
        trainer: settings of ``conf/train.yaml`` that make the Trainer use it.
        command: the same for a command that is started.
        why_unmeasured: why times and memory of a GPU cannot be taken here, in words; "" where they can.
    """

    torch_device = torch.device("cpu")
    attention: Attention = "auto"
    trainer: tuple[str, ...] = ("trainer=cpu",)
    command: tuple[str, ...] = ("trainer=cpu",)
    why_unmeasured = "this is no GPU"

    def running(self) -> AbstractContextManager[object]:
        """Return the context in which everything on the device happens."""
        return nullcontext()

    def counting(self) -> AbstractContextManager[object]:
        """Return the context of what is only counted or timed, and not judged by its values."""
        return nullcontext()

    def adopt(self, trainer: pl.Trainer) -> None:
        """Change in a Trainer what no setting can."""

    def wait(self) -> None:
        """Wait until the device has done all that it was given."""

    def clock(self) -> float:
        """Return the time at which the device has done all that it was given, seconds."""
        self.wait()
        return time.perf_counter()

    def held(self) -> int:
        """Return the bytes in use, and let ``peak`` count from now on.

        On a processor these are the pages of the process, so that small tensors hide in freed ones (Linux).
        """
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)  # gives back what was freed, or the next rise would go unseen
        Path("/proc/self/clear_refs").write_text("5")  # sets the high-water mark to what is held now
        return self.peak()

    def peak(self) -> int:
        """Return the most bytes that were in use since ``held``."""
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

    def alone_seconds(self, candidates: Mapping[str, Run], rounds: int) -> dict[str, float]:
        """Return the median time of each on the device alone, without the host that gives the orders.

        Empty where there is no such time.
        """
        return {}

    @contextmanager
    def waits(self) -> Iterator[list[str]]:
        """Collect the places at which the host waits for the device, a line for each time."""
        yield []

    @contextmanager
    def launches(self) -> Iterator[list[int]]:
        """Put the number of kernels that are launched into a list, at the end of the block."""
        yield []


class Gpu(Device):
    """An NVIDIA GPU."""

    trainer = command = ("trainer=gpu",)
    why_unmeasured = ""

    def __init__(self, index: int = 0) -> None:
        self.torch_device = torch.device("cuda", index)
        self._cycles_per_second = 0.0
        self._cache: torch.Tensor | None = None

    def wait(self) -> None:
        """Wait until the GPU has done all that it was given."""
        torch.cuda.synchronize(self.torch_device)

    def held(self) -> int:
        """Return the bytes of all tensors, and let ``peak`` count from now on."""
        gc.collect()
        self.wait()
        torch.cuda.reset_peak_memory_stats(self.torch_device)
        return torch.cuda.memory_allocated(self.torch_device)

    def peak(self) -> int:
        """Return the most bytes of tensors since ``held``."""
        return torch.cuda.max_memory_allocated(self.torch_device)

    def alone_seconds(self, candidates: Mapping[str, Run], rounds: int) -> dict[str, float]:
        """Return the median time of each on the GPU alone.

        The GPU is kept busy until the host has given all orders, so that no gap between kernels is the
        host's. Then its cache is overwritten, as it is in a training step.
        """
        self._cycles_per_second = self._cycles_per_second or self._measured_cycles()
        if self._cache is None:
            self._cache = torch.empty(1 << 28, dtype=torch.int8, device=self.torch_device)
        ahead = {name: 2 * self._called_seconds(run) + 1e-3 for name, run in candidates.items()}
        taken: dict[str, list[float]] = {name: [] for name in candidates}
        for _ in range(rounds):
            for name, run in candidates.items():
                start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
                torch.cuda._sleep(int(ahead[name] * self._cycles_per_second))
                self._cache.zero_()
                start.record()
                run()
                end.record()
                end.synchronize()
                taken[name].append(start.elapsed_time(end) / 1e3)
        self._cache = None
        return {name: statistics.median(seconds) for name, seconds in taken.items()}

    def _called_seconds(self, run: Run) -> float:
        run()
        start = self.clock()
        run()
        return self.clock() - start

    def _measured_cycles(self) -> float:
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        torch.cuda._sleep(10_000_000)
        end.record()
        end.synchronize()
        return 1e7 / (start.elapsed_time(end) / 1e3)

    @contextmanager
    def waits(self) -> Iterator[list[str]]:
        """Collect the places at which the host waits for the GPU, by torch's synchronisation debug mode.

        That mode knows copies, ``.item()``, ``nonzero`` and their kind, and no explicit ``synchronize``.
        """
        found: list[str] = []
        show = warnings.showwarning

        def note(message: Any, *rest: Any, **options: Any) -> None:
            if "synchronizing CUDA operation" in str(message):
                found.append(_place())
            elif "prototype feature" not in str(message):
                show(message, *rest, **options)

        before = torch.cuda.get_sync_debug_mode()
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.showwarning = note
            torch.cuda.set_sync_debug_mode("warn")
            try:
                yield found
            finally:
                torch.cuda.set_sync_debug_mode(before)

    @contextmanager
    def launches(self) -> Iterator[list[int]]:
        """Count the kernels that the host launches, by torch's profiler."""
        activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
        count: list[int] = []
        with torch.profiler.profile(activities=activities) as profile:
            yield count
            self.wait()
        launched = sum(
            event.count
            for event in profile.key_averages()
            if event.key.startswith(("cudaLaunchKernel", "cuLaunchKernel"))
        )
        if launched:  # a profiler without CUPTI sees none
            count.append(launched)


_RAYTRAN, _TORCH = (str(Path(package.__file__ or "").resolve().parent) for package in (raytran, torch))


def _place() -> str:
    """Return the innermost line of raytran that is being run, and that which called it."""
    frames = traceback.extract_stack()
    outside = [frame for frame in frames if not frame.filename.startswith((_TORCH, __file__))]
    chosen = [frame for frame in frames if frame.filename.startswith(_RAYTRAN)] or outside
    names = [f"{'/'.join(Path(frame.filename).parts[-2:])}:{frame.lineno}" for frame in chosen[-2:]]
    return " < ".join(reversed(names))


def this_device() -> Device:
    """Return the GPU of this rank, which is the first in a run of one, and without one the processor."""
    return Gpu(int(os.environ.get("LOCAL_RANK", "0"))) if torch.cuda.is_available() else Device()
