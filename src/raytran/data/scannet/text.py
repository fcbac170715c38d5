# SPDX-License-Identifier: Apache-2.0
"""The text files of a scan: matrices, ``<scan>.txt`` and ``_info.txt``, and what must hold for cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.errors import DataError

INFO_FILES = ("_info.txt", "info.txt")
"""Names of the C++ exporter's file of facts."""

_MAX_BYTES = 1 << 20
"""Bytes of a file that are read; ScanNet's files have some hundred."""

_MAX_OFFSET = 0.15
"""Largest distance of the principal point from the image centre, in widths or heights."""


def read_matrix(path: Path) -> NDArray[np.float64] | None:
    """Return the matrix of 16 or 9 numbers in a text file as 4×4, or None if the file does not hold one."""
    try:
        return _matrix(_start_of(path).decode("ascii"))
    except (OSError, ValueError):
        return None


def are_rigid(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of ``(n, 4, 4)`` matrices are finite and hold a rotation in their upper left, ``(n,)``."""
    finite = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    rotation = np.where(finite[:, None, None], poses[:, :3, :3], 0.0)
    error = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    return finite & (error < 0.01) & (np.linalg.det(rotation) > 0)


def read_header(path: Path) -> dict[str, str]:
    """Return the ``key = value`` lines of a text file; none if there is no such file."""
    if not path.is_file():
        return {}
    lines = _start_of(path).decode("utf-8", errors="replace").splitlines()
    return {
        key.strip(): value.strip() for key, equals, value in (line.partition("=") for line in lines) if equals
    }


def axis_alignment(header: dict[str, str], path: Path) -> Tensor:
    """Return ``(4, 4)`` aligned_from_world; the identity if the header has none.

    Raises:
        DataError: it is not 16 numbers.
    """
    if "axisAlignment" not in header:
        return torch.eye(4, dtype=torch.float64)
    try:
        values = [float(word) for word in header["axisAlignment"].split()]
        return torch.tensor(values, dtype=torch.float64).reshape(4, 4)
    except (ValueError, RuntimeError) as error:
        raise DataError(f"axisAlignment in {path} is not 16 numbers: mend or remove it") from error


def read_intrinsics(path: Path) -> NDArray[np.float64]:
    """Return the 4×4 camera matrix of a text file of 16 or 9 numbers, or of ``_info.txt``.

    Raises:
        DataError: the file is missing or holds no such matrix.
    """
    if path.name in INFO_FILES:
        try:
            matrix = _matrix(read_header(path).get("m_calibrationColorIntrinsic", ""))
        except ValueError:
            matrix = None
    else:
        matrix = read_matrix(path)
    if matrix is None:
        state = "does not hold a 4x4 or 3x3 camera matrix" if path.is_file() else "is missing"
        raise DataError(f"{path} {state}: write fx, fy, cx, cy of the stored colour images there as 4x4")
    return matrix


def check_intrinsics(
    matrix: NDArray[np.float64],
    path: Path,
    *,
    image_size: tuple[int, int],
    header: dict[str, str],
    any_size: bool = False,
) -> Tensor:
    """Return ``(3, 3)`` float64 intrinsics after checking that they can belong to images of ``image_size``.

    Args:
        matrix: 4×4.
        path: where it was read, for errors.
        image_size: ``(H, W)`` of the stored images.
        header: lines of ``<scan>.txt``, whose ``colorWidth`` and ``colorHeight`` may be another image size.
        any_size: accept intrinsics for another image size, as the data doctor does to name the fault.

    Raises:
        DataError: they are not finite, not positive, or for another image size.
    """
    if not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise DataError(
            f"{path} does not hold a camera matrix with positive focal lengths: "
            "write fx, fy, cx, cy of the stored colour images there as 4x4"
        )
    if any_size:
        return torch.from_numpy(matrix[:3, :3].copy())
    height, width = image_size
    distance = _distance_from_centre(matrix, width, height)
    try:
        stated = int(header.get("colorWidth", width)), int(header.get("colorHeight", height))
    except ValueError:
        stated = width, height
    # A header may state 0 for a size it does not know.
    fits_stated_size = (
        min(stated) > 0 and stated != (width, height) and _distance_from_centre(matrix, *stated) < distance
    )
    if distance > _MAX_OFFSET or fits_stated_size:
        raise DataError(
            f"{path} has its principal point at ({matrix[0, 2]:.1f}, {matrix[1, 2]:.1f}), so it is for "
            f"another image size than the stored {width}x{height}: "
            "scale its first row by W'/W and its second by H'/H"
        )
    return torch.from_numpy(matrix[:3, :3].copy())


def fits_better(matrix: NDArray[np.float64], size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether a camera matrix has its principal point nearer to the middle of one size than of another."""
    near, far = (_distance_from_centre(matrix, width, height) for height, width in (size, other))
    return size != other and near < far


def _start_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_MAX_BYTES)


def _matrix(text: str) -> NDArray[np.float64]:
    values = np.array([float(word) for word in text.split()])
    if values.size != 9:
        return values.reshape(4, 4)
    matrix = np.eye(4)
    matrix[:3, :3] = values.reshape(3, 3)
    return matrix


def _distance_from_centre(matrix: NDArray[np.float64], width: int, height: int) -> float:
    return max(abs(matrix[0, 2] / width - 0.5), abs(matrix[1, 2] / height - 0.5))
