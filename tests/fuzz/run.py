# SPDX-License-Identifier: Apache-2.0
"""Hands inputs to processes that read them, and ends those that take too long or are killed."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import shutil
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

from .inputs import Input, all_inputs
from .worker import SECONDS, Verdict, Watch, judge, make, work

_FORK = multiprocessing.get_context("fork")


@dataclass
class Result:
    """What a run of the fuzzer found.

    Attributes:
        inputs: read.
        accepted: of these, read to the end.
        findings: what is wrong.
        seconds: of all together.
        slowest: seconds of the slowest input.
        largest: most megabytes that one input took.
        by_kind: inputs, and those accepted, by kind.
    """

    inputs: int = 0
    accepted: int = 0
    findings: list[Verdict] = field(default_factory=list)
    seconds: float = 0.0
    slowest: float = 0.0
    largest: float = 0.0
    by_kind: dict[str, Counter[str]] = field(default_factory=dict)

    def add(self, verdict: Verdict) -> None:
        """Count one input."""
        self.inputs += 1
        self.accepted += verdict.accepted
        self.slowest = max(self.slowest, verdict.seconds)
        self.largest = max(self.largest, verdict.megabytes)
        counts = self.by_kind.setdefault(verdict.name, Counter())
        counts["inputs"] += 1
        counts["accepted"] += verdict.accepted
        if verdict.finding:
            self.findings.append(verdict)

    def __str__(self) -> str:
        return (
            f"{self.inputs} inputs in {self.seconds:.0f} s, {self.accepted} read, {len(self.findings)} "
            f"findings; slowest {self.slowest:.1f} s, most memory {self.largest:.0f} MB"
        )


class _Worker:
    """A process that reads inputs; a new one takes its place when it dies."""

    def __init__(self, kinds: list[Input], seed: int, folder: Path) -> None:
        self._arguments = (kinds, seed, folder)
        self._start()

    def _start(self) -> None:
        self._pipe, other = _FORK.Pipe()
        self._process = _FORK.Process(target=work, args=(*self._arguments, other), daemon=True)
        self._process.start()
        other.close()

    @property
    def pipe(self) -> Connection:
        return self._pipe

    def begin(self, number: int) -> None:
        """Hand over an input."""
        self.number, self.began = number, time.monotonic()
        self._before = self._processor_seconds()
        self._pipe.send(number)

    def _processor_seconds(self) -> float:
        """Return how long a core has worked for the process."""
        try:
            fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return 0.0
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def result(self) -> Verdict | None:
        """Return the verdict if there is one, also of a process that died or takes too long; else None."""
        try:
            if self._pipe.poll():
                verdict: Verdict = self._pipe.recv()
                return verdict
        except (EOFError, OSError):
            pass
        took = time.monotonic() - self.began
        alive = self._process.is_alive()
        # A machine that is busy with other things gives it little time.
        if alive and took < 60 * SECONDS and self._processor_seconds() - self._before < 3 * SECONDS:
            return None
        finding = (
            f"no answer after {took:.0f} s" if alive else f"the interpreter died ({self._process.exitcode})"
        )
        self._process.kill()
        self._process.join()
        kinds = self._arguments[0]
        self._start()
        return Verdict(self.number, kinds[self.number % len(kinds)].name, finding, False, "", took, 0.0)

    def end(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join(5)
        if self._process.is_alive():
            self._process.kill()


def fuzz(
    count: int,
    *,
    seed: int = 0,
    keep: Path | None = None,
    names: str = "",
    processes: int = 1,
    first: int = 0,
    seconds: float = float("inf"),
) -> Result:
    """Read inputs.

    Args:
        count: how many; every kind comes in turn.
        seed: another one makes other inputs.
        keep: folder for the inputs of findings, each with what was said; None: they are not kept.
        names: only kinds whose name contains one of these words, parted by commas.
        processes: readers at work at a time.
        first: number of the first input.
        seconds: begin no input after so long.
    """
    result = Result()
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as root:
        kinds = _chosen(Path(root), names)
        workers = [_Worker(kinds, seed, Path(root) / f"in{index}") for index in range(processes)]
        numbers = iter(range(first, first + count))
        busy = []
        for worker in workers:
            if (number := next(numbers, None)) is not None:
                worker.begin(number)
                busy.append(worker)
        while busy:
            multiprocessing.connection.wait([worker.pipe for worker in busy], timeout=1)
            for worker in list(busy):
                verdict = worker.result()
                if verdict is None:
                    continue
                result.add(verdict)
                if verdict.finding and keep is not None:
                    _keep(kinds, verdict, seed, keep)
                number = next(numbers, None) if time.monotonic() - began < seconds else None
                if number is None:
                    busy.remove(worker)
                else:
                    worker.begin(number)
        for worker in workers:
            worker.end()
    result.seconds = time.monotonic() - began
    return result


def one(number: int, *, seed: int = 0, keep: Path, names: str = "") -> Verdict:
    """Read one input again, in this process, where it stays."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as root:
        kinds = _chosen(Path(root), names)
        folder = keep / "again"
        folder.parent.mkdir(parents=True, exist_ok=True)
        return judge(kinds[number % len(kinds)], number, seed, folder.resolve(), Watch())


def _chosen(root: Path, names: str) -> list[Input]:
    parts = names.split(",")
    kinds = [kind for kind in all_inputs(root / "plain") if any(part in kind.name for part in parts)]
    if not kinds:
        raise SystemExit(f"no kind of input is called {names}")
    return kinds


def _keep(kinds: list[Input], verdict: Verdict, seed: int, keep: Path) -> None:
    folder = keep / f"{seed}-{verdict.number}-{verdict.name}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    if len(list(folder.parent.iterdir())) > 200:
        return
    make(kinds[verdict.number % len(kinds)], verdict.number, seed, folder)
    folder.mkdir(exist_ok=True)
    (folder / "finding.txt").write_text(f"{verdict.finding}\n\n{verdict.said}\n", errors="replace")
    shutil.rmtree(folder / "__pycache__", ignore_errors=True)
