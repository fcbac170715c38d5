# SPDX-License-Identifier: Apache-2.0
"""Shows how far a sweep is: bars on a terminal, now and then a line elsewhere."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from rich.progress import BarColumn, TaskID, TextColumn

from raytran.run.sweep.job import FAILED, FINISHED, Job
from raytran.training.live_bar import LiveBar, is_terminal

_log = logging.getLogger(__name__)

READ_SECONDS = 5.0
"""Between two looks into the jobs' folders."""
TELL_SECONDS = 60.0
"""Between two lines at least, where there is no terminal."""
_TENTHS = 10
_ENOUGH = 0.05
"""Share of a job from which on the time that the rest takes can be told."""


class SweepProgress:
    """Tells how many jobs of a sweep are done, how far those are that run, and how long the rest will take.

    The rest is taken to go as fast as what has been done since the start; jobs that have finished before do
    not count for that.

    Args:
        jobs: all jobs of this call.
        silent: says nothing at all.
        clock: in seconds.
    """

    def __init__(
        self, jobs: Sequence[Job], *, silent: bool = False, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._jobs = list(jobs)
        self._clock = clock
        self._began = self._read_at = self._told_at = clock()
        self._standing = {job.number: job.standing() for job in self._jobs}
        self._before = {number: standing.share for number, standing in self._standing.items()}
        self._tenth = {number: int(share * _TENTHS) for number, share in self._before.items()}
        self._silent = silent
        self._bar: LiveBar | None = None
        self._tasks: dict[int, TaskID] = {}
        self._all: TaskID | None = None

    def __enter__(self) -> Self:
        if not self._silent and is_terminal():
            # A description is no markup: settings have brackets.
            text = TextColumn("{task.description}", markup=False)
            self._bar = LiveBar(text, BarColumn(20), TextColumn("{task.fields[said]}", markup=False))
            self._all = self._bar.add_task(self.count(), total=len(self._jobs), said="")
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def count(self) -> str:
        """Return ``2 of 12 jobs done`` and how many of them have failed, if any."""
        failed = sum(job.status == FAILED for job in self._jobs)
        done = sum(job.status == FINISHED for job in self._jobs)
        return f"{done} of {len(self._jobs)} jobs done" + (f", {failed} failed" if failed else "")

    def left(self) -> str:
        """Return ``, about 34 min left``, or nothing where it cannot be told yet."""
        seconds = self.seconds_left()
        return "" if seconds is None else f", about {in_words(seconds)} left"

    def seconds_left(self) -> float | None:
        """Return how long the jobs that are not done will take; None where none has come far enough."""
        share = {number: standing.share for number, standing in self._standing.items()}
        done = sum(share.values()) - sum(self._before.values())
        left = sum(1 - share[job.number] for job in self._jobs if job.status not in (FINISHED, FAILED))
        return (self._clock() - self._began) * left / done if left and done >= _ENOUGH else None

    def look(self, running: Sequence[Job]) -> None:
        """Look how far the running jobs are if the last look is some time ago, and show it."""
        if self._silent or self._clock() - self._read_at < READ_SECONDS:
            return
        self._read_at = self._clock()
        for job in running:
            self._standing[job.number] = job.standing()
        self.show(running)

    def ended(self, job: Job, running: Sequence[Job]) -> None:
        """Take down that a job has ended."""
        self._standing[job.number] = job.standing()
        self.show(running)
        if not self._silent and self._bar is None:
            self._told_at = self._clock()
            _log.info("%s%s", self.count(), self.left())

    def show(self, running: Sequence[Job]) -> None:
        """Draw the bars anew, or log a line a job if one of them has gone on by a tenth of its way."""
        if self._silent:
            return
        if self._bar is None:
            self._tell(running)
            return
        if self._all is not None:
            done = sum(standing.share for standing in self._standing.values())
            self._bar.update(
                self._all, description=self.count(), completed=done, said=self.left().removeprefix(", ")
            )
        for number in [number for number in self._tasks if number not in {job.number for job in running}]:
            self._bar.remove_task(self._tasks.pop(number))
        for job in running:
            if job.number not in self._tasks:
                self._tasks[job.number] = self._bar.add_task(job.name, total=1.0, said="starts")
            standing = self._standing[job.number]
            self._bar.update(self._tasks[job.number], completed=standing.share, said=standing.text)

    def _tell(self, running: Sequence[Job]) -> None:
        tenths = {job.number: int(self._standing[job.number].share * _TENTHS) for job in running}
        has_gone_on = any(tenth > self._tenth[number] for number, tenth in tenths.items())
        if not has_gone_on or self._clock() - self._told_at < TELL_SECONDS:
            return
        self._told_at = self._clock()
        self._tenth |= tenths
        for job in running:
            _log.info("%s: %s", job.name, self._standing[job.number].text)
        _log.info("%s%s", self.count(), self.left())


def in_words(seconds: float) -> str:
    """Return a time as ``40 s``, ``34 min`` or ``2 h 10 min``."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
