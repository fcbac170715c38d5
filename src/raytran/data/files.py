# SPDX-License-Identifier: Apache-2.0
"""Files and folders of work that may be killed at any time.

What is written here appears under its name whole or not at all. The name of unfinished work says which
process writes it, and only that one removes it as long as it lives. A record of settings keeps work that was
begun with some settings from going on with others.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

from raytran.data.locks import Process
from raytran.data.text import read_json_object
from raytran.errors import DataError

UNFINISHED = ".unfinished-"
"""Start of every temporary name; the process that writes there follows."""

_ABANDONED_SECONDS = 7 * 24 * 3600.0
"""Work of another machine, which may go on unseen, was left if nothing in it has changed for so long."""

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
_NOT_EMPTY = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)
_LONGEST_NAME = 60


def unfinished_name(ending: str = "") -> str:
    """Return a temporary name that no other call gets and that says which process writes there.

    Args:
        ending: its end, e.g. the final name of a file, so that the suffix tells the format.
    """
    return f"{UNFINISHED}{Process.this()}-{uuid4().hex[:8]}{'-' if ending else ''}{ending[-_LONGEST_NAME:]}"


def is_abandoned(path: Path) -> bool:
    """Say whether nobody writes any more what has a temporary name.

    The process that wrote it is dead, or of another machine and has changed nothing for a week, or the name
    tells no process, which is of an earlier version of ours.
    """
    writer = Process.named_in(path.name)
    if writer is None:
        return True
    lives = writer.lives()
    if lives is not None:
        return not lives
    try:
        return time.time() - max(_times_below(path)) > _ABANDONED_SECONDS
    except FileNotFoundError:
        return False  # its writer is at work


def _times_below(path: Path) -> Iterator[float]:
    yield path.lstat().st_mtime
    if path.is_dir() and not path.is_symlink():
        for folder, _, names in os.walk(path):
            yield from (os.lstat(os.path.join(folder, name)).st_mtime for name in (".", *names))


@contextmanager
def whole_file(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Give a temporary path to write a file to; the file gets the name ``path`` when the block ends.

    If the block raises, the temporary file is deleted and what was at ``path`` stays. Folders above are made.

    Args:
        path: the final name. The temporary name ends in the same way, so that its suffix tells the format.
        durable: flush the file to the disk before it gets its name, so that it outlives a power cut. What
            killed calls left of this file, which may be large, is removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(unfinished_name(path.name))
    if durable:
        ending = glob.escape(path.name[-_LONGEST_NAME:])
        sweep(path.parent, f"{UNFINISHED}{ending}", f"{UNFINISHED}*-{ending}")
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
        replace: a folder that is there already is replaced; of several processes the last one wins. Otherwise
            it stays: another process has finished the same work meanwhile.

    Raises:
        DataError: the folder above was removed meanwhile.
    """
    sibling = folder.with_name(unfinished_name())
    try:
        new = sibling / folder.name
        new.mkdir(parents=True)
        yield new
        while not _renamed(new, folder):
            if not replace:
                break
            with contextlib.suppress(FileNotFoundError):  # another process has put it aside
                os.replace(folder, sibling / uuid4().hex)
    except FileNotFoundError as error:
        if sibling.is_dir():
            raise
        raise DataError(
            f"{folder.parent} was removed while {folder.name} was written: start again"
        ) from error
    finally:
        shutil.rmtree(sibling, ignore_errors=True)


def _renamed(new: Path, folder: Path) -> bool:
    """Give a folder its final name; return False if another folder has it."""
    try:
        os.replace(new, folder)
    except OSError as error:
        # Windows says that access is denied.
        if folder.is_dir() and (error.errno in _NOT_EMPTY or isinstance(error, PermissionError)):
            return False
        if error.errno in _NOT_EMPTY and not folder.exists():  # put aside by another process just now
            return _renamed(new, folder)
        raise
    return True


def sweep(root: Path, *patterns: str) -> None:
    """Remove the files and folders below ``root`` that match ``patterns`` as in ``Path.glob``, if any do.

    What has a temporary name stays unless it is abandoned: another process may be writing it.
    """
    for pattern in patterns:
        for path in list(root.glob(pattern)):
            if path.name.startswith(UNFINISHED) and not is_abandoned(path):
                continue
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
    """Return the error of a disk that takes no more, which ``error`` is or comes from; None for other errors.

    The disk is full or read-only, or the file is larger than it may be.
    """
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))  # an error raised a second time may come from itself
        if isinstance(error, OSError) and error.errno in _DISK_FULL:
            return error
        if isinstance(error, OSError) and str(error).startswith("encoder error"):
            # Pillow's encoders write by themselves and forget why they could not.
            return OSError(errno.ENOSPC, "the disk does not take the picture")
        error = error.__cause__ or error.__context__
    return None


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
