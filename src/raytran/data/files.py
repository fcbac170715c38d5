# SPDX-License-Identifier: Apache-2.0
"""Files and folders of work that may be killed at any time.

What is written here appears under its name whole or not at all. A lock keeps two processes from one folder,
and a record of settings keeps work that was begun with some settings from going on with others.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

from raytran.data.text import read_json_object
from raytran.errors import DataError, RaytranError

_log = logging.getLogger(__name__)

UNFINISHED = ".unfinished-"
"""Start of every temporary name. A file or folder with such a name was left by a call that was killed."""

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@contextmanager
def whole_file(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Give a temporary path to write a file to; the file gets the name ``path`` when the block ends.

    If the block raises, the temporary file is deleted and what was at ``path`` stays. Folders above are made.

    Args:
        path: the final name. The temporary name ends in the same way, so that its suffix tells the format.
        durable: flush the file to the disk before it gets its name, so that it outlives a power cut. Only one
            process at a time may write such a file; what a killed call left is overwritten.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unique = "" if durable else f"{uuid4().hex[:12]}-"
    temporary = path.with_name(f"{UNFINISHED}{unique}{path.name}")
    try:
        yield temporary
        if durable:
            with temporary.open("r+b") as file:
                os.fsync(file.fileno())
        os.replace(temporary, path)
        if durable:
            _flush_folder(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _flush_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk where the system can do it."""
    with contextlib.suppress(OSError):  # not every system lets a folder be opened
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file, see ``whole_file``."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON with its keys in the order given, see ``whole_file``."""
    write_text(path, json.dumps(value, indent=1) + "\n")


@contextmanager
def finished_folder(folder: Path, *, replace: bool = False) -> Iterator[Path]:
    """Give an empty folder of the same name to fill; it takes ``folder``'s place when the block ends.

    If the block raises, nothing is left of it and what was at ``folder`` stays.

    Args:
        folder: the final name; folders above it are made.
        replace: a folder that is there already is replaced. Otherwise it stays: another process has finished
            the same work meanwhile.
    """
    sibling = folder.with_name(f"{UNFINISHED}{folder.name}.{os.getpid()}")
    shutil.rmtree(sibling, ignore_errors=True)
    try:
        new = sibling / folder.name
        new.mkdir(parents=True)
        yield new
        if replace and folder.exists():
            os.replace(folder, sibling / "earlier")
        try:
            os.replace(new, folder)
        except OSError:
            if replace or not folder.is_dir():
                raise
    finally:
        shutil.rmtree(sibling, ignore_errors=True)


def sweep(root: Path, *patterns: str) -> None:
    """Remove the files and folders below ``root`` that match ``patterns`` as in ``Path.glob``, if any do."""
    for pattern in patterns:
        for path in list(root.glob(pattern)):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def bytes_below(folder: Path) -> int:
    """Return the total size of all files below a folder; 0 if there is no such folder."""
    total = 0
    folders = [folder] if folder.is_dir() else []
    while folders:
        with os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(Path(entry.path))
                else:
                    total += entry.stat(follow_symlinks=False).st_size
    return total


def disk_full(error: BaseException | None) -> OSError | None:
    """Return the error of a full or read-only disk that ``error`` is or comes from, None for other errors."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _DISK_FULL:
            return error
        error = error.__cause__ or error.__context__
    return None


@contextmanager
def exclusive_lock(path: Path, *, if_taken: RaytranError) -> Iterator[int]:
    """Lock a file until the block ends or this process is killed; the file is made if it is missing.

    Gives the descriptor of the lock. A process that inherits the descriptor holds the lock too.

    Args:
        path: the file to lock.
        if_taken: raised if another process holds the lock.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise if_taken from error
        except (ImportError, OSError) as error:
            # Windows and some network disks have no such lock: the user must not start two processes there.
            _log.debug("cannot lock %s: %s", path, error)
        yield file.fileno()


class SettingsRecord:
    """A JSON file with the settings that the work in a folder was begun with.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> dict[str, Any]:
        """Return the recorded settings; empty if there is no record or it is damaged."""
        try:
            return read_json_object(self.path)
        except DataError:
            return {}

    def begin(self, settings: Mapping[str, Any]) -> list[str]:
        """Write the settings if there is no record yet; return the names of those that differ from it.

        Work may go on only if none differs. All differ from a damaged record.

        Args:
            settings: values that JSON can hold. A missing setting is the same as one that is None.
        """
        if not self.path.exists():
            write_json(self.path, settings)
        recorded = self.read()
        asked = json.loads(json.dumps(settings))
        return [name for name in asked | recorded if asked.get(name) != recorded.get(name)]
