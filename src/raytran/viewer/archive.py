# SPDX-License-Identifier: Apache-2.0
"""Reads ``.npz`` files that anybody may have written: plain arrays, no larger than the file can hold."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

_MAX_ARRAYS = 50_000
_MOST_UNPACKED, _FREE = 50, 64 * 2**20
"""Bytes of all arrays for each byte of the file, and for any file: most voxels are empty and take none."""

_KINDS = "biuf"
"""Of numbers: booleans, whole and real ones."""


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file that ``numpy.savez`` wrote, by name.

    Raises:
        ValueError: it is cut short, some of its bytes have changed, it holds something else than numbers, or
            claims more than it holds.
        OSError: it cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
            unpacked = sum(part.file_size for part in parts)
            if len(parts) > _MAX_ARRAYS or unpacked > _MOST_UNPACKED * path.stat().st_size + _FREE:
                raise ValueError(f"it unpacks to {unpacked:,} bytes in {len(parts)} arrays")
            arrays = {}
            for part in parts:
                with archive.open(part) as file:
                    arrays[part.filename.removesuffix(".npy")] = _read_array(file, part.file_size)
            return arrays
    except (ValueError, OSError):
        raise
    except Exception as error:  # a made-up file can fail anywhere in the readers
        raise ValueError(f"{type(error).__name__}: {str(error)[:80]}") from error


def _read_array(file: Any, size: int) -> NDArray[Any]:
    """Return the one array in a part of ``size`` bytes; no memory is taken for what it does not hold."""
    shape, in_columns, dtype = _read_header(file)
    content = file.read(size)
    if dtype.kind not in _KINDS or math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError("an array has other bytes than its header says")
    order: Literal["C", "F"] = "F" if in_columns else "C"
    return np.frombuffer(content, dtype=dtype).reshape(shape, order=order).copy()


def _read_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    read = npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0
    return read(file)
