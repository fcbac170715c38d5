# SPDX-License-Identifier: Apache-2.0
"""Does the same work on many items in worker processes, which end with the process that started them."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from raytran.errors import DataError

Item = TypeVar("Item")
Result = TypeVar("Result")

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
        ProcessPoolExecutor(workers, mp_context=context, initializer=_become_worker) as pool,
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


def _become_worker() -> None:
    """Leave interrupts to the parent process, and end with it even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
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
