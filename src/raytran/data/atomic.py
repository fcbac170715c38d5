# SPDX-License-Identifier: Apache-2.0
"""Files and folders that appear under their name whole or not at all, whatever ends the process."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

UNFINISHED = ".unfinished-"
"""Start of every temporary name; what carries one is the rest of a call that was killed."""

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def write_text(path: Path, text: str) -> None:
    """Write a text file under its name only when it is complete; folders above it are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{UNFINISHED}{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON, keys in the order given; see ``write_text``."""
    write_text(path, json.dumps(value, indent=1) + "\n")


@contextmanager
def finished_folder(folder: Path) -> Iterator[Path]:
    """Give an empty folder of the same name to fill, which takes ``folder``'s place when the block ends.

    If the block raises, nothing is left. If another process finished ``folder`` meanwhile, that one stays.
    """
    sibling = folder.with_name(f"{UNFINISHED}{folder.name}.{os.getpid()}")
    shutil.rmtree(sibling, ignore_errors=True)
    try:
        fresh = sibling / folder.name
        fresh.mkdir(parents=True)
        yield fresh
        try:
            os.replace(fresh, folder)
        except OSError:
            if not folder.is_dir():
                raise
    finally:
        shutil.rmtree(sibling, ignore_errors=True)


def sweep(root: Path, *patterns: str) -> None:
    """Remove the files and folders below ``root`` that match, as for ``Path.glob``; they may be none."""
    for pattern in patterns:
        for path in list(root.glob(pattern)):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def bytes_below(folder: Path) -> int:
    """Return the sizes of all files below a folder, which need not exist."""
    total, folders = 0, [folder] if folder.is_dir() else []
    while folders:
        with os.scandir(folders.pop()) as found:
            for item in found:
                if item.is_dir(follow_symlinks=False):
                    folders.append(Path(item.path))
                else:
                    total += item.stat(follow_symlinks=False).st_size
    return total


def no_room(error: BaseException | None) -> OSError | None:
    """Return the error of a full or read-only disk that ``error`` is or comes from, or None."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            return error
        error = error.__cause__ or error.__context__
    return None
