# SPDX-License-Identifier: Apache-2.0
"""Does the same work on many items in worker processes, which end with the process that started them."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from itertools import islice
from types import TracebackType
from typing import Any, TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from raytran.errors import DataError

Item = TypeVar("Item")
Result = TypeVar("Result")

ENDS_WITH = "RAYTRAN_ENDS_WITH"
"""Environment variable with the number of a process; a command that is started with it ends with that."""

_POLL_SECONDS = 0.3
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def work_on(
    items: Sequence[Item],
    function: Callable[[Item], Result],
    *,
    label: str,
    processes: int = 0,
    items_each: int = 1,
    progress: bool = True,
) -> Iterator[Result]:
    """Yield ``function(item)`` of each item, in the order in which they are finished.

    An item is handed out only when a process is free for it, so an interrupt or an error waits for the items
    in work and no others.

    Args:
        items: what to work on; each is sent to a process by itself.
        function: a function of a module, or a ``functools.partial`` of one.
        label: name of the progress bar.
        processes: 0 for one per core; 1 works in this process.
        items_each: fewest items for which another process is worth its start.
        progress: show a progress bar.

    Raises:
        DataError: a process was ended from outside; and whatever ``function`` raises.
    """
    workers = min(processes or os.cpu_count() or 1, len(items) // items_each)
    columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, disable=not progress or not items) as bar:
        task = bar.add_task(label, total=len(items))
        for result in (
            _sequentially(items, function) if workers <= 1 else _in_parallel(items, function, workers)
        ):
            bar.advance(task)
            yield result


def _sequentially(items: Sequence[Item], function: Callable[[Item], Result]) -> Iterator[Result]:
    for item in items:
        yield function(item)


def _in_parallel(items: Sequence[Item], function: Callable[[Item], Result], workers: int) -> Iterator[Result]:
    context = multiprocessing.get_context("spawn")
    with (
        _one_thread_each(),
        ProcessPoolExecutor(workers, mp_context=context, initializer=become_worker) as pool,
    ):
        try:
            yield from _as_completed(items, function, workers, pool)
        except BrokenProcessPool as error:
            raise DataError(
                "a worker process was ended from outside, perhaps because memory ran out: "
                "give the same command again with a smaller processes="
            ) from error


def _as_completed(
    items: Sequence[Item], function: Callable[[Item], Result], workers: int, pool: ProcessPoolExecutor
) -> Iterator[Result]:
    waiting = iter(items)
    running = {pool.submit(function, item) for item in islice(waiting, workers)}
    while running:
        done, running = wait(running, return_when=FIRST_COMPLETED)
        running |= {pool.submit(function, item) for item in islice(waiting, len(done))}
        for future in done:
            yield future.result()


def become_worker() -> None:
    """Leave interrupts to the parent process, and end with it even if it is killed.

    The signals by which a run is asked to stop may reach all its processes; a run that saves itself needs its
    workers until it has.
    """
    for name in ("SIGINT", "SIGUSR1"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    sys.excepthook = partial(_say_unless_alone, before=sys.excepthook)
    end_with_parent()


def _say_unless_alone(
    kind: type[BaseException],
    error: BaseException,
    trace: TracebackType | None,
    *,
    before: Callable[..., Any],
) -> None:
    """Show an error of a thread, but not that the parent has gone in the middle of a word."""
    if not isinstance(error, ConnectionError | EOFError):
        before(kind, error, trace)


def end_with_parent(last_words: str = "", *, parent: int | None = None) -> None:
    """End this process soon after the one that has started it, however that may end.

    Args:
        last_words: a sentence to say then.
        parent: number of the process that has started this one; it may have ended since. None: the present
            parent.
    """
    parent = os.getppid() if parent is None else parent
    watch = threading.Thread(
        target=_watch_parent, args=(parent, last_words), name="parent-watch", daemon=True
    )
    watch.start()


def _watch_parent(parent: int, last_words: str) -> None:
    if sys.platform == "win32":  # where the number of the parent stays
        process = multiprocessing.parent_process()
        if process is None:
            return
        process.join()
    while os.getppid() == parent and sys.platform != "win32":
        time.sleep(_POLL_SECONDS)
    end_now(last_words)


def end_now(last_words: str = "") -> None:
    """End this process and its workers at once, without waiting for any other process."""
    if last_words:
        sys.stderr.write(f"raytran: {last_words}\n")
        sys.stderr.flush()
    for worker in multiprocessing.active_children():
        worker.kill()
    os._exit(1)


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    """Make processes that are started inside the block use one thread each."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
