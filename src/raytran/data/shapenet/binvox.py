# SPDX-License-Identifier: Apache-2.0
"""Voxels of CAD models in binvox files, read and written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from raytran.errors import DataError

_MAX_SIZE = 512
"""Most cells along a side that are read; ShapeNet has 128."""

_MAX_BYTES = 64 * 2**20
"""Largest file that is read; ShapeNet's have less than one megabyte."""


def read_binvox(path: Path) -> tuple[NDArray[np.bool_], NDArray[np.float64], float]:
    """Read a binvox file.

    Returns:
        ``(S, S, S)`` bool indexed [x, y, z]; ``translate`` ``(3,)``; ``scale``. The centre of cell ``i`` lies
        at ``translate + (i + 0.5) / S * scale`` in the coordinates of the mesh.

    Raises:
        DataError: the file is missing or damaged.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError(f"it is larger than {_MAX_BYTES / 2**20:.0f} MB")
        header, body = path.read_bytes().split(b"data\n", 1)
        fields = {
            words[0]: words[1:] for line in header.decode("ascii").splitlines() if (words := line.split())
        }
        size = int(fields["dim"][0])
        runs = np.frombuffer(body, dtype=np.uint8).reshape(-1, 2)
        # Both are tested before any cell is made: a few bytes can claim any number of cells.
        if (
            fields["dim"] != 3 * fields["dim"][:1]
            or not 0 < size <= _MAX_SIZE
            or int(runs[:, 1].sum(dtype=np.int64)) != size**3
        ):
            raise ValueError(f"its runs do not fill {' × '.join(fields['dim'])} cells")
        # The file runs over x, then z, then y (fastest).
        cells = np.repeat(runs[:, 0] > 0, runs[:, 1]).reshape(size, size, size).transpose(0, 2, 1)
        return cells, np.array(fields["translate"], dtype=np.float64), float(fields["scale"][0])
    except OSError as error:
        raise DataError(f"cannot read the voxels {path}: {error.strerror}; restore the file") from error
    except (ValueError, KeyError, IndexError) as error:
        raise DataError(f"the voxel file {path} is damaged ({error}); restore the file") from error


def write_binvox(path: Path, cells: NDArray[np.bool_], translate: ArrayLike, scale: float) -> None:
    """Write ``(S, S, S)`` cells [x, y, z] as a binvox file; the reverse of :func:`read_binvox`."""
    flat = cells.transpose(0, 2, 1).reshape(-1)
    starts = np.flatnonzero(np.diff(flat, prepend=~flat[:1]))
    lengths = np.diff(starts, append=flat.size)
    # A run holds at most 255 cells: longer ones are cut into full runs and a rest.
    pieces = -(-lengths // 255)
    counts = np.full(int(pieces.sum()), 255, dtype=np.uint8)
    counts[np.cumsum(pieces) - 1] = (lengths - 1) % 255 + 1
    runs = np.stack([np.repeat(flat[starts], pieces).astype(np.uint8), counts], axis=1)
    sides = " ".join([str(cells.shape[0])] * 3)
    place = " ".join(repr(float(value)) for value in np.asarray(translate))
    header = f"#binvox 1\ndim {sides}\ntranslate {place}\nscale {float(scale)!r}\ndata\n"
    path.write_bytes(header.encode("ascii") + runs.tobytes())
