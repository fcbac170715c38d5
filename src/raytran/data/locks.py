# SPDX-License-Identifier: Apache-2.0
"""Who works where: processes that can be told apart, and a lock that says who holds it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import re
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path
from uuid import uuid4

from raytran.errors import DataError, RaytranError

_log = logging.getLogger(__name__)

_PROCESS = re.compile(r"([0-9a-f]{8})-(\d{1,19})-(\d{1,19})")
_LONGEST_COMMAND = 60
_UNKNOWN = "it does not say which"
_POLL_SECONDS = 0.2
_STARTING_SECONDS = 60.0
"""A claim without content is that of a process which has just made it; an older one was left by a kill."""


@dataclass(frozen=True)
class Process:
    """A process, as others can tell whether it still lives.

    Attributes:
        machine: digest of host, boot and PID namespace; within one of them a PID says something.
        pid: its number.
        started: when, in clock ticks since the boot, since numbers are used again; 0: the system does not
            tell.
    """

    machine: str
    pid: int
    started: int

    def __str__(self) -> str:
        return f"{self.machine}-{self.pid}-{self.started}"

    @staticmethod
    def this() -> Process:
        """Return the process that calls."""
        return Process(_machine(), os.getpid(), _start_of(os.getpid()) or 0)

    @staticmethod
    def named_in(text: str) -> Process | None:
        """Return the process whose ``str`` is somewhere in ``text``, None if none is."""
        found = _PROCESS.search(text)
        return None if found is None else Process(found[1], int(found[2]), int(found[3]))

    def lives(self) -> bool | None:
        """Return whether the process runs; None if that cannot be told from here."""
        if self.machine != _machine():
            return None
        if self.started:
            return _start_of(self.pid) == self.started
        if sys.platform == "win32":  # where os.kill ends processes
            return None
        try:
            os.kill(self.pid, 0)
        except (ProcessLookupError, OverflowError):
            return False
        except PermissionError:
            pass
        return True


@cache
def _machine() -> str:
    parts = [socket.gethostname()]
    with contextlib.suppress(OSError):  # other systems than Linux do not have them
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii"))
        parts.append(str(Path("/proc/self/ns/pid").stat().st_ino))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]


def _start_of(pid: int) -> int | None:
    """Return when a process was started; None if it does not run or the system does not tell."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        state, *numbers = text.rpartition(")")[2].split()
        return None if state in "ZX" else int(numbers[18])
    except (OSError, ValueError, IndexError):
        return None


@dataclass(frozen=True)
class Holder:
    """Who holds a lock, as written into its file.

    Attributes:
        process: the process, as ``str``.
        host: the machine's name.
        command: as typed, shortened.
        since: when the lock was taken, local time.
    """

    process: str = field(default_factory=lambda: str(Process.this()))
    host: str = field(default_factory=socket.gethostname)
    command: str = field(default_factory=lambda: _typed_command())
    since: str = field(default_factory=lambda: datetime.now().strftime("%Y-%m-%d %H:%M:%S"))

    def __str__(self) -> str:
        process = Process.named_in(self.process)
        number = "" if process is None else f"number {process.pid} "
        return f"{number}on {self.host}, {self.command}, since {self.since}"

    @staticmethod
    def read(path: Path) -> Holder | None:
        """Return what a lock's file says; None if it says nothing yet, or something else."""
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            return Holder(
                **{name: str(values[name])[:100] for name in ("process", "host", "command", "since")}
            )
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def as_text(self) -> str:
        """Return what ``read`` reads."""
        return json.dumps(asdict(self)) + "\n"


def _typed_command() -> str:
    program, *words = sys.argv or [""]
    path = Path(program)
    if path.parent.name == "raytran":
        program = f"raytran.{path.stem}"
    text = " ".join([program if program not in ("", "-c") else "python", *words])
    return text if len(text) <= _LONGEST_COMMAND else f"{text[: _LONGEST_COMMAND - 1]}…"


@contextmanager
def exclusive_lock(path: Path, *, if_taken: Callable[[str], RaytranError]) -> Iterator[int]:
    """Lock a file until the block ends or this process dies; the file is made, and removed afterwards.

    Gives the descriptor of the lock. A process that inherits the descriptor holds the lock too.

    Args:
        path: the file to lock; nothing else may be in it.
        if_taken: makes the error to raise if another process holds the lock, from a text that says which.

    Raises:
        DataError: the file cannot be made.
    """
    lock = _acquire(path)
    if lock is None:
        raise if_taken(_who(path))
    with _held(lock):
        yield lock.descriptor


@contextmanager
def lock_when_free(path: Path, *, work: str) -> Iterator[bool]:
    """Wait until nobody holds a lock, saying for whom, then hold it; see ``exclusive_lock``.

    Gives whether another process held it.

    Args:
        path: the file to lock.
        work: what the holder does, for the log, e.g. ``makes the rooms in …``.

    Raises:
        DataError: the file cannot be made.
    """
    told = ""
    while (lock := _acquire(path)) is None:
        who = _who(path)
        if who not in (told, _UNKNOWN) or not told:
            _log.info("another process %s (%s): waiting for it to end", work, who)
            told = who
        time.sleep(_POLL_SECONDS)
    with _held(lock):
        yield bool(told)


@dataclass(frozen=True)
class _Lock:
    """A lock that is held.

    Attributes:
        descriptor: of the open file.
        files: to be removed when it is given back.
    """

    descriptor: int
    files: tuple[Path, ...]


@contextmanager
def _held(lock: _Lock) -> Iterator[None]:
    try:
        yield
    finally:
        # Removed while it is held: who opens the file later than that finds a new one.
        for path in lock.files:
            with contextlib.suppress(OSError):
                path.unlink()
        os.close(lock.descriptor)


def _who(path: Path) -> str:
    """Return who holds a lock and, where only its name locks, what to do if that process is gone."""
    claim = _claim_of(path)
    holder = Holder.read(path)
    if holder is None and (holder := Holder.read(claim)) is not None:
        return f"{holder}; if it has ended, remove {claim}"
    return _UNKNOWN if holder is None else str(holder)


def _acquire(path: Path) -> _Lock | None:
    """Return the lock, None if another process holds it."""
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = _open(path)
        except FileNotFoundError:  # the folder was removed meanwhile
            continue
        except OSError as error:
            raise DataError(
                f"cannot write to {path.parent} ({error.strerror}): give another folder, or mend that"
            ) from error
        try:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        except (ImportError, OSError) as error:
            _log.debug("%s cannot be locked by the system: %s", path, error)
            return _acquire_by_name(path, descriptor)
        if _is_still(path, descriptor):
            _write_holder(descriptor)
            return _Lock(descriptor, (path,))
        os.close(descriptor)  # that of a holder who has removed it


def _open(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except PermissionError:  # another user's, who holds it
        return os.open(path, os.O_RDONLY)


def _is_still(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except OSError:
        return False


def _write_holder(descriptor: int) -> None:
    with contextlib.suppress(OSError):  # on a full disk the lock holds, and does not say for whom
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, Holder().as_text().encode(), 0)


def _claim_of(path: Path) -> Path:
    return path.with_name(f"{path.name}-claim")


def _acquire_by_name(path: Path, descriptor: int) -> _Lock | None:
    """Lock where the system cannot (Windows, some network disks): by a file that only one can make.

    The claim of a process that died is taken over, if it was one of this machine; that of another machine
    holds until somebody removes it.
    """
    claim = _claim_of(path)
    while True:
        try:
            with claim.open("x", encoding="utf-8") as file:
                file.write(Holder().as_text())
            return _Lock(descriptor, (claim, path))
        except FileExistsError:
            if not _remove_dead(claim):
                os.close(descriptor)
                return None


def _remove_dead(claim: Path) -> bool:
    """Remove a claim whose process is dead; return whether it is gone."""
    try:
        age = time.time() - claim.stat().st_mtime
    except FileNotFoundError:
        return True
    holder = Holder.read(claim)
    process = None if holder is None else Process.named_in(holder.process)
    is_dead = age > _STARTING_SECONDS if process is None else process.lives() is False
    if not is_dead:
        return False
    # Renamed first: of two who find it dead, only one may remove it, and not the claim of the other.
    grave = claim.with_name(f"{claim.name}-{uuid4().hex[:8]}")
    with contextlib.suppress(OSError):
        os.rename(claim, grave)
        if Holder.read(grave) != holder:
            os.link(grave, claim)
        grave.unlink()
    return True
