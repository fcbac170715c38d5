# SPDX-License-Identifier: Apache-2.0
"""A cache of boolean arrays on disk; an entry's key is a digest of all its inputs, so it is never stale."""

from __future__ import annotations

import hashlib
import math
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from raytran.data.files import whole_file
from raytran.errors import DataError


class MaskCache:
    """A folder of boolean arrays, safe for any number of readers and writers at once.

    Entries are packed bits, compressed by zlib, whose checksum is tested on reading. A damaged entry counts
    as missing. Writers replace whole files, so a reader sees the old one or the new one.

    Args:
        folder: where the entries lie; made on the first write.
    """

    def __init__(self, *, folder: Path) -> None:
        self._folder = Path(folder)

    def read(self, kind: str, key: str, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
        """Return the array stored under ``key``, or None if there is none or it is damaged.

        Args:
            kind: sub-folder, e.g. ``"foreground"``.
            key: digest of everything the array depends on (``digest``).
            shape: of the array.
        """
        arrays, missing = self.read_stack(kind, [key], shape)
        return None if missing else arrays[0]

    def read_stack(
        self, kind: str, keys: Sequence[str], shape: tuple[int, ...]
    ) -> tuple[NDArray[np.bool_], list[int]]:
        """Return several arrays of one shape, ``(N, *shape)``, and the positions of those that are missing.

        Missing arrays are all False in the stack. One call is faster than N of ``read``: all bits are
        unpacked at once, straight into the stack.
        """
        count = math.prod(shape)
        packed = np.zeros((len(keys), -(-count // 8)), dtype=np.uint8)
        missing = []
        for i, key in enumerate(keys):
            try:
                bits = zlib.decompress(self._path(kind, key).read_bytes(), bufsize=packed.shape[1] + 1)
            except (OSError, zlib.error):
                bits = b""
            if len(bits) == packed.shape[1]:
                packed[i] = np.frombuffer(bits, dtype=np.uint8)
            else:
                missing.append(i)
        arrays = np.unpackbits(packed, axis=1, count=count).reshape(len(keys), *shape)
        return arrays.view(np.bool_), missing

    def write(self, kind: str, key: str, array: NDArray[np.bool_]) -> None:
        """Store an array under ``key``.

        Raises:
            DataError: the folder cannot be written.
        """
        try:
            with whole_file(self._path(kind, key)) as temporary:
                temporary.write_bytes(zlib.compress(np.packbits(array).tobytes()))
        except OSError as error:
            raise DataError(
                f"cannot write to the cache of training targets at {self._folder} ({error.strerror}): "
                "make room there, or choose another folder with data.dataset.cache_dir="
            ) from error

    def _path(self, kind: str, key: str) -> Path:
        return self._folder / kind / key[:2] / f"{key}.bits.z"


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


@cache
def _content_digest(path: Path, _size: int, _time: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
