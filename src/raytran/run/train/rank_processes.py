# SPDX-License-Identifier: Apache-2.0
"""The processes of a run: its ranks end together, whichever is lost, and one sentence says so.

Lightning starts the other ranks of a machine as commands of their own. They watch their parent, the first
rank (``raytran.data.workers.end_with_parent``); here the first rank watches them.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import lightning.pytorch as pl
from torch import distributed as dist

from raytran.data.workers import ENDS_WITH, end_now
from raytran.errors import DataError, RaytranError
from raytran.training.callbacks.stop_signals import StopRequestedError

_LOST = (
    "another rank of this run has ended: it said why, or it was killed; mend that, then give the same "
    "command again, with resume=auto to go on from the last checkpoint"
)
_LOST_WORKER = (
    "a process that loads scenes was ended from outside, perhaps because memory ran out: set a smaller "
    "views.num_workers, then give the same command again with resume=auto"
)
_POLL_SECONDS = 0.3
_GRACE_SECONDS = 3.0
"""How long a rank that hears of a lost one may take to end by itself, with its loggers closed."""

_PATIENCE_SECONDS = 10.0

_OF_LOST_RANKS = re.compile(
    r"gloo/|\bNCCL|ncclR|TCPStore|closed by peer|reset by peer|Connection refused|Broken pipe"
)
_OF_LOST_WORKERS = re.compile(r"DataLoader worker .*(exited unexpectedly|killed by signal)")


class LostRankError(RaytranError):
    """Another rank of the run has ended."""


@contextmanager
def rank_processes(trainer: pl.Trainer) -> Iterator[None]:
    """Let the ranks of a fit inside the block end together.

    Raises:
        LostRankError: another rank has ended.
        DataError: a process that loads scenes was killed.
    """
    ended = threading.Event()
    watch = threading.Thread(target=_watch, args=(trainer, ended), name="rank-watch", daemon=True)
    if trainer.world_size > 1 and trainer.global_rank == 0:
        os.environ[ENDS_WITH] = str(os.getpid())
        watch.start()
    try:
        yield
    except BaseException as error:
        ended.set()
        if isinstance(error, StopRequestedError):
            _wait_for(_started(trainer))
            raise
        explained = _explained(trainer, error)
        if isinstance(explained, LostRankError) and trainer.global_rank > 0:
            _leave_the_word_to_the_first_rank()
        _kill(_started(trainer))
        if explained is None:
            raise
        raise explained from error
    else:
        ended.set()
        _wait_for(_started(trainer))
    finally:
        os.environ.pop(ENDS_WITH, None)


def _explained(trainer: pl.Trainer, error: BaseException) -> RaytranError | None:
    """Return what an error means that came of the loss of another process, None if it did not."""
    if not isinstance(error, RuntimeError) or isinstance(error, RaytranError):
        return None
    if _OF_LOST_WORKERS.search(str(error)):
        return DataError(_LOST_WORKER)
    if trainer.world_size > 1 and (isinstance(error, dist.DistError) or _OF_LOST_RANKS.search(str(error))):
        return LostRankError(_LOST)
    return None


def _started(trainer: pl.Trainer) -> list[subprocess.Popen[bytes]]:
    """Return the ranks that Lightning has started from this process."""
    return list(getattr(trainer.strategy.launcher, "procs", ()))


def _watch(trainer: pl.Trainer, ended: threading.Event) -> None:
    """End this process soon after one of the ranks that it started has failed, unless it ends by itself."""
    while not ended.wait(_POLL_SECONDS):
        started = _started(trainer)
        _take_over_from_lightning()
        if any(process.poll() for process in started):
            if not ended.wait(_GRACE_SECONDS):  # it waits for the lost rank, perhaps for long
                _kill(started)
                end_now(_LOST)
            return


def _take_over_from_lightning() -> None:
    """Keep Lightning's observer, which looks every five seconds, from killing this process without a word."""
    for thread in threading.enumerate():
        if thread.name == "child-process-observer":
            vars(thread)["_child_processes"] = []


def _wait_for(processes: list[subprocess.Popen[bytes]]) -> None:
    """Wait until the other ranks have ended: they would take the end of this one for a loss."""
    deadline = time.monotonic() + _PATIENCE_SECONDS
    for process in processes:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, deadline - time.monotonic()))


def _kill(processes: list[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        with contextlib.suppress(OSError):
            process.kill()
    _wait_for(processes)


def _leave_the_word_to_the_first_rank() -> None:
    """Wait a little: the first rank says what happened and ends this one, if it is there and started it."""
    if "LOCAL_RANK" in os.environ and "TORCHELASTIC_RUN_ID" not in os.environ and sys.platform != "win32":
        time.sleep(_GRACE_SECONDS + 1)
