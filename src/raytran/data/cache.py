# SPDX-License-Identifier: Apache-2.0
"""Arrays kept on disk under a key that names all their inputs, so that an entry never goes stale."""

from __future__ import annotations

import hashlib
import os
import zipfile
import zlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from raytran.errors import DataError

_UNREADABLE = (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error)


class ArrayCache:
    """A folder of boolean arrays, safe for any number of readers and writers at once.

    Entries are bits packed into compressed ``.npz`` files, whose checksum is tested on reading. A damaged
    entry is made again. Writers replace whole files, so a reader meets the old one or the new one.

    Args:
        folder: where the entries lie; made on the first write.
    """

    def __init__(self, *, folder: Path) -> None:
        self._folder = Path(folder)

    def get(self, kind: str, key: str, make: Callable[[], NDArray[np.bool_]]) -> NDArray[np.bool_]:
        """Return the array stored under ``key``, or make and store it.

        Args:
            kind: sub-folder, e.g. ``"foreground"``.
            key: hexadecimal digest of everything the array depends on (``digest``).
            make: computes the array.

        Raises:
            DataError: the folder cannot be written.
        """
        path = self._folder / kind / key[:2] / f"{key}.npz"
        try:
            return _read(path)
        except _UNREADABLE:
            array = make()
        try:
            _write(path, array)
        except OSError as error:
            raise DataError(
                f"cannot write to the cache of training targets at {self._folder} ({error.strerror}): "
                "make room there or choose another cache_dir"
            ) from error
        return array


def digest(*parts: object) -> str:
    """Return a hexadecimal digest of values: arrays by dtype, shape and content, others by their ``repr``."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            total.update(f"{part.dtype}{part.shape}".encode())
            total.update(np.ascontiguousarray(part).tobytes())
        else:
            total.update(repr(part).encode())
        total.update(b"\0")
    return total.hexdigest()


def file_digest(path: Path) -> str:
    """Return a digest of a file's content; read once per process as long as size and time stay.

    Raises:
        DataError: the file does not exist or cannot be read.
    """
    try:
        status = path.stat()
        return _content_digest(path, status.st_size, status.st_mtime_ns)
    except OSError as error:
        raise DataError(
            f"cannot read {path} ({error.strerror}): check that the data set is complete"
        ) from error


@lru_cache(maxsize=None)
def _content_digest(path: Path, _size: int, _time: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read(path: Path) -> NDArray[np.bool_]:
    with np.load(path) as entry:
        shape = tuple(entry["shape"].tolist())
        return np.unpackbits(entry["bits"], count=int(np.prod(shape))).reshape(shape).astype(bool)


def _write(path: Path, array: NDArray[np.bool_]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.stem}-{uuid4().hex}.tmp")
    try:
        with temporary.open("wb") as file:
            np.savez_compressed(file, bits=np.packbits(array), shape=np.array(array.shape))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
