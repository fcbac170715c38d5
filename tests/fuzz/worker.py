# SPDX-License-Identifier: Apache-2.0
"""Reads one input after another in a process of its own, within bounds of time and memory, and watches it.

A finding is everything but a result within bounds, or a ``RaytranError`` of one short printable sentence.
"""

from __future__ import annotations

import logging
import os
import random
import resource
import shutil
import sys
import time
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from raytran.errors import RaytranError

from .inputs import Input, NonsenseError

SECONDS = 10
MEGABYTES = 1024
LONGEST = 300
"""Characters of a sentence, without the folder's path."""

MOST_LINES = 20
"""Lines that reading one input may log."""

_STARTS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.forkpty", "os.spawn")
_WRITES = (
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.mkdir",
    "os.link",
    "os.symlink",
    "os.truncate",
    "os.chmod",
)
_REACHES = ("socket.connect", "socket.bind", "socket.sendto", "socket.getaddrinfo")


@dataclass(frozen=True)
class Verdict:
    """What became of one input.

    Attributes:
        number: of the input.
        name: of the kind of input.
        finding: what is wrong, in one line; empty if nothing is.
        accepted: whether it was read to the end.
        said: the sentence, or a traceback.
        seconds: time.
        megabytes: memory at its peak, beyond what the process had before.
    """

    number: int
    name: str
    finding: str
    accepted: bool
    said: str
    seconds: float
    megabytes: float


class Watch(logging.Handler):
    """Notes what is logged, and what an audit hook hears of files, processes and the network."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.acts: list[str] = []
        self.allowed: tuple[str, ...] = ()
        self._on = False
        sys.addaudithook(self._hear)

    def start(self, folder: Path) -> None:
        """Listen while something in ``folder`` is read; that folder alone may be written to."""
        self.lines, self.acts = [], []
        self.allowed = (str(folder.resolve()), "/dev/null", "/dev/shm")
        self._on = True

    def stop(self) -> None:
        """Listen no longer."""
        self._on = False

    def emit(self, record: logging.LogRecord) -> None:
        """Note a line."""
        self.lines.append(record.getMessage())

    def _hear(self, event: str, arguments: tuple) -> None:
        if not self._on:
            return
        if event.startswith(_STARTS) or event in _REACHES:
            self.acts.append(f"{event} {arguments!r:.200}")
        elif event in _WRITES or (event == "open" and _is_write(arguments)):
            path = os.path.abspath(os.fsdecode(arguments[0])) if isinstance(arguments[0], str | bytes) else ""
            if path and not path.startswith(self.allowed):
                self.acts.append(f"{event} {path}")


def _is_write(arguments: tuple) -> bool:
    _, mode, flags = arguments
    if isinstance(mode, str):
        return any(letter in mode for letter in "wax+")
    return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC))


def _memory(name: str) -> float:
    """Return a line of ``/proc/self/status`` in megabytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1024
    return 0.0


def make(kind: Input, number: int, seed: int, folder: Path) -> None:
    """Write input ``number`` to a folder, which is emptied first.

    A few mutations are such as no file can hold: lists that contain themselves, or a hundred million numbers.
    Then the input stays undamaged.
    """
    shutil.rmtree(folder, ignore_errors=True)
    kind.write(folder)
    try:
        kind.mutate(folder, random.Random(f"{seed} {number}"))
    except (MemoryError, RecursionError, ValueError):
        shutil.rmtree(folder, ignore_errors=True)
        kind.write(folder)


def judge(kind: Input, number: int, seed: int, folder: Path, watch: Watch) -> Verdict:
    """Make input ``number``, read it, and say what became of it."""
    make(kind, number, seed, folder)
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak of memory
    before = _memory("VmRSS")
    finding, accepted, said = "", False, ""
    began = time.process_time()  # not of a clock: other processes may have the machine
    watch.start(folder)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            kind.read(folder)
            accepted = True
        except RaytranError as error:
            said = str(error)
            finding = _fault_of_sentence(said, folder)
        except NonsenseError as error:
            finding = said = f"nonsense accepted: {error}"
        except BaseException as error:
            said = traceback.format_exc()[-3000:]
            finding = f"{type(error).__name__}: {_last_line_of_ours(error)}"
    watch.stop()
    seconds, megabytes = time.process_time() - began, _memory("VmHWM") - before
    if watch.acts:
        finding, said = f"acted: {watch.acts[0]}", "\n".join(watch.acts)
    elif not finding and len(watch.lines) > MOST_LINES:
        finding, said = f"logged {len(watch.lines)} lines", "\n".join(watch.lines[:5])
    elif not finding and any(len(line.replace(str(folder), "")) > 2 * LONGEST for line in watch.lines):
        finding, said = "logged a long line", max(watch.lines, key=len)
    elif not finding and warned:
        where = f"{Path(warned[0].filename).name}:{warned[0].lineno}"
        finding, said = f"warned: {where} {str(warned[0].message)[:100]}", ""
    if seconds > SECONDS:
        finding = f"took {seconds:.1f} s"
    if megabytes > MEGABYTES:
        finding = f"took {megabytes:.0f} MB"
    return Verdict(number, kind.name, finding, accepted, said, seconds, megabytes)


def _fault_of_sentence(said: str, folder: Path) -> str:
    """Return what is wrong with a sentence, empty if nothing is."""
    text = said
    for path in (str(folder), str(folder.resolve()), folder.name):
        text = text.replace(path, "")
    if len(text) > LONGEST:
        return f"a sentence of {len(text)} characters: {text[:60]}"
    if not text.isprintable():
        return f"a sentence of several lines, or not printable: {text[:60]!r}"
    return ""


def _last_line_of_ours(error: BaseException) -> str:
    """Return the last place in the package that a traceback passes through, which tells findings apart."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/raytran/" in frame.filename] or frames
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno} {str(error)[:80]!r}"


def work(kinds: Sequence[Input], seed: int, folder: Path, orders: Connection) -> None:
    """Judge the inputs whose numbers come through a pipe until it is closed."""
    sys.dont_write_bytecode = True
    soft = int(_memory("VmSize") + 3 * MEGABYTES) * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (soft, soft))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    watch = Watch()
    for name in ("raytran", "PIL", "trimesh", "libav"):
        log = logging.getLogger(name)
        log.propagate = False
        log.addHandler(watch)
    while True:
        try:
            number = orders.recv()
        except EOFError:
            return
        kind = kinds[number % len(kinds)]
        try:
            verdict = judge(kind, number, seed, folder, watch)
        except Exception:  # of the fuzzer itself
            watch.stop()
            said = traceback.format_exc()[-3000:]
            verdict = Verdict(number, kind.name, f"the fuzzer failed: {said[-200:]!r}", False, said, 0.0, 0.0)
        orders.send(verdict)
