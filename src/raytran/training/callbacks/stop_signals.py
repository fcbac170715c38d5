# SPDX-License-Identifier: Apache-2.0
"""Signals that ask a run to stop: Ctrl-C, SIGTERM, and SIGUSR1 as SLURM sends it before the time is up."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import torch
import torch.distributed as dist

_log = logging.getLogger(__name__)

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)


@contextmanager
def forward_signals(stop: Callable[[int], None]) -> Iterator[None]:
    """Hand signals that ask to stop to ``stop`` while the block runs, in a process that waits for others."""
    before = {signum: signal.signal(signum, lambda number, _: stop(number)) for signum in SIGNALS}
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


class StopRequestedError(Exception):
    """A signal has asked the run to stop, and the run has saved itself.

    Attributes:
        signum: number of the signal.
    """

    def __init__(self, signum: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name}")
        self.signum = signum


class StopSignals:
    """Listens for signals and lets all ranks agree on the step at which to obey them.

    A signal may reach some of the ranks only, and each of them at another moment. So the ranks ask each other
    between two batches, over gloo: no GPU is waited for.
    """

    def __init__(self) -> None:
        self._received = 0
        self._group: dist.ProcessGroup | None = None

    def listen(self, world_size: int) -> None:
        """Handle the signals from now on; all ranks must call this together.

        Lightning puts the earlier handlers back at the end of a fit.
        """
        if world_size > 1:
            self._group = dist.new_group(backend="gloo")
        if threading.current_thread() is threading.main_thread():
            for signum in SIGNALS:
                signal.signal(signum, self._on_signal)

    def agreed(self) -> int:
        """Return the number of the signal that some rank has received, 0 if none has."""
        if self._group is None:
            return self._received
        received = torch.tensor([self._received])
        dist.all_reduce(received, dist.ReduceOp.MAX, group=self._group)
        return int(received)

    def gather(self, value: object) -> list[object]:
        """Return ``value`` of every rank, in their order."""
        if self._group is None:
            return [value]
        values: list[object] = [None] * dist.get_world_size(self._group)
        dist.all_gather_object(values, value, group=self._group)
        return values

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:
        if signum == signal.SIGINT and self._received == signal.SIGINT:
            raise KeyboardInterrupt
        self._received = signum
        if signum == signal.SIGINT:
            _log.info("stopping after this step; press Ctrl-C again to stop at once")
        else:
            _log.info("%s received: stopping after this step", signal.Signals(signum).name)
