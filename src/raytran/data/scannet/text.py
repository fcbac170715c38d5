# SPDX-License-Identifier: Apache-2.0
"""The text files of a scan: matrices, ``<scan>.txt`` and ``_info.txt``, and what must hold for cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.data.images import is_turned
from raytran.data.scan import EMPTY, LEFT_HANDED, LOST, SCALED, SKEWED
from raytran.data.text import read_table, read_text
from raytran.errors import DataError
from raytran.geometry.camera import FARTHEST_CENTER, center_offset, other_image_size
from raytran.geometry.checks import rigid_motions
from raytran.limits import FOCAL_LENGTH, PIXEL, POSITION, as_numbers, shown

INFO_FILES = ("_info.txt", "info.txt")
"""Names of the C++ exporter's file of facts."""

_MAX_BYTES = 1 << 20
"""Bytes of a file that are read; ScanNet's files have some hundred."""


def read_matrix(path: Path) -> NDArray[np.float64] | None:
    """Return the matrix of 16, 12 or 9 numbers in a text file as 4×4, or None if it does not hold one."""
    try:
        return _matrix(read_table(path, max_bytes=_MAX_BYTES).ravel())
    except (DataError, ValueError):
        return None


def read_pose(path: Path) -> NDArray[np.float64] | None:
    """Return the pose of 16 or 12 numbers in a text file as 4×4, or None if the file does not hold one.

    What programs write is read: numbers parted by commas or semicolons, a byte order mark, UTF-16.
    """
    try:
        values = read_table(path, max_bytes=_MAX_BYTES).ravel()
    except DataError:
        return None
    return _matrix(values) if values.size in (12, 16) else None


def are_rigid(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of ``(n, 4, 4)`` matrices are finite and hold a rotation in their upper left, ``(n,)``."""
    is_rigid: NDArray[np.bool_] = rigid_motions(torch.from_numpy(poses)).numpy() & _are_within(poses)
    return is_rigid


def pose_faults(poses: NDArray[np.float64]) -> list[str | None]:
    """Return for each of ``(n, 4, 4)`` matrices why it is no pose; None if it is one.

    The reasons are those of ``raytran.data.scan``.
    """
    finite = _are_within(poses)
    rotation = np.where(finite[:, None, None], poses[:, :3, :3], 0.0)
    gram = rotation @ rotation.swapaxes(1, 2)
    square = np.trace(gram, axis1=1, axis2=2) / 3
    is_uniform = np.abs(gram - square[:, None, None] * np.eye(3)).max(axis=(1, 2)) < 0.01 * square
    determinant = np.linalg.det(rotation)
    return [
        None if fits else _pose_fault(*facts)
        for fits, *facts in zip(are_rigid(poses), finite, square, is_uniform, determinant, strict=True)
    ]


def _are_within(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of ``(n, 4, 4)`` matrices are finite and of positions that a room can have, ``(n,)``."""
    return np.asarray((np.abs(poses) <= POSITION.high).all(axis=(1, 2)))  # not-a-number is not


def _pose_fault(finite: bool, square: float, is_uniform: bool, determinant: float) -> str:
    """Return why a matrix is no pose.

    Args:
        finite: whether its numbers are.
        square: mean of the squared lengths of its axes.
        is_uniform: whether the axes are at right angles and of one length.
        determinant: of the upper left 3×3.
    """
    if not finite:
        return LOST
    if square < 1e-12:
        return EMPTY
    if not is_uniform:
        return SKEWED
    return LEFT_HANDED if determinant < 0 else f"{SCALED} {square**0.5:.2g}"


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
    """Return the 4×4 camera matrix of a text file of 16 or 9 numbers or of fx fy cx cy, or of ``_info.txt``.

    Raises:
        DataError: the file is missing or holds no such matrix.
    """
    if path.name in INFO_FILES:
        try:
            text = read_header(path).get("m_calibrationColorIntrinsic", "")
            matrix = _matrix(np.array([float(word) for word in text.split()]))
        except ValueError:
            matrix = None
    else:
        try:
            values = read_table(path, max_bytes=_MAX_BYTES).ravel()
            matrix = camera_matrix(*values.tolist()) if values.size == 4 else _matrix(values)
        except (DataError, ValueError):
            matrix = None
    if matrix is None:
        state = "does not hold a 4x4 or 3x3 camera matrix" if path.is_file() else "is missing"
        raise DataError(
            f"{path} {state}: write fx, fy, cx, cy of the stored colour images there as 4x4, or give "
            "intrinsics=fx,fy,cx,cy"
        )
    return matrix


def read_frame_cameras(path: Path, names: Sequence[str]) -> tuple[Tensor, Tensor | None]:
    """Read the name of a frame, a tab, and ``fx fy cx cy [left top right bottom]``, a line for each frame.

    Args:
        path: the file.
        names: of the frames that are wanted.

    Returns:
        ``(n, 3, 3)`` float64 intrinsics in the order of ``names``, and ``(n, 4)`` what each frame shows of
        its image; None where the file does not say, for images that are all picture.

    Raises:
        DataError: it cannot be read, a frame has no line, or a line holds no camera.
    """
    rows: dict[str, list[float]] = {}
    for line in read_text(path).splitlines():
        name, _, numbers = line.rpartition("\t")
        words = numbers.split()
        if len(words) not in (4, 8):
            raise DataError(
                f"{path} has the line {shown(line)}, no frame with its camera: prepare the scan again"
            )
        rows[name] = [_as_number(word, path) for word in words]
    missing = [name for name in names if name not in rows]
    if missing or len({len(rows[name]) for name in names}) != 1:
        state = f"has no line for frame {missing[0]}" if missing else "has lines of different lengths"
        raise DataError(f"{path} {state}: prepare the scan again")
    values = np.array([rows[name] for name in names])
    focal = as_numbers(values[:, :2], (-1, 2), FOCAL_LENGTH, f"a focal length in {path}")
    rest = as_numbers(values[:, 2:], (len(names), -1), PIXEL, f"a pixel in {path}")
    matrices = np.stack([camera_matrix(*f, *c)[:3, :3] for f, c in zip(focal, rest[:, :2], strict=True)])
    if values.shape[1] == 4:
        return torch.from_numpy(matrices), None
    if not (rest[:, 4:] > rest[:, 2:4]).all():
        raise DataError(f"{path} has a frame that shows nothing of its image: prepare the scan again")
    return torch.from_numpy(matrices), torch.from_numpy(rest[:, 2:].copy())


def _as_number(word: str, path: Path) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise DataError(
            f"{path} has {shown(word)} where a number is needed: prepare the scan again"
        ) from error


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """Return the 4×4 camera matrix of intrinsics in pixels."""
    return np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64)


def header_intrinsics(header: dict[str, str]) -> NDArray[np.float64] | None:
    """Return the 4×4 camera matrix of the colour camera that ``<scan>.txt`` states, or None."""
    try:
        fx, fy, cx, cy = (float(header[key]) for key in ("fx_color", "fy_color", "mx_color", "my_color"))
    except (KeyError, ValueError):
        return None
    matrix = camera_matrix(fx, fy, cx, cy)
    return matrix if np.isfinite(matrix).all() and min(fx, fy) > 0 else None


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
    is_pixels = (np.abs(matrix) <= FOCAL_LENGTH.high).all()  # not-a-number is not
    if not is_pixels or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise DataError(
            f"{path} does not hold a camera matrix with positive focal lengths: "
            "write fx, fy, cx, cy of the stored colour images there as 4x4"
        )
    if any_size:
        return torch.from_numpy(matrix[:3, :3].copy())
    height, width = image_size
    center = float(matrix[0, 2]), float(matrix[1, 2])
    distance = center_offset(center, image_size)
    try:
        stated = int(header.get("colorWidth", width)), int(header.get("colorHeight", height))
    except ValueError:
        stated = width, height
    # A header may state 0 for a size it does not know.
    fits_stated_size = (
        min(stated) > 0
        and stated != (width, height)
        and center_offset(center, (stated[1], stated[0])) < distance
    )
    other = other_image_size(center, image_size)
    if other is not None and is_turned(other, image_size):
        raise DataError(
            f"{path} has its principal point at ({center[0]:.1f}, {center[1]:.1f}), so it is for images "
            f"turned by 90° against the stored {width}x{height}: give the intrinsics of the stored images"
        )
    if other is not None or distance > FARTHEST_CENTER or fits_stated_size:
        raise DataError(
            f"{path} has its principal point at ({center[0]:.1f}, {center[1]:.1f}), so it is for "
            f"another image size than the stored {width}x{height}: "
            "scale its first row by W'/W and its second by H'/H"
        )
    return torch.from_numpy(matrix[:3, :3].copy())


def fits_better(matrix: NDArray[np.float64], size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether a camera matrix has its principal point nearer to the middle of one size than of another."""
    center = matrix[0, 2], matrix[1, 2]
    near, far = (center_offset(center, each) for each in (size, other))
    return size != other and near < far


def _start_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_MAX_BYTES)


def _matrix(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 16 numbers, 12 (3×4) or 9 (3×3) as a 4×4 matrix; others raise ValueError."""
    matrix = np.eye(4)
    if values.size == 9:
        matrix[:3, :3] = values.reshape(3, 3)
        return matrix
    if values.size == 12:
        matrix[:3] = values.reshape(3, 4)
        return matrix
    return values.reshape(4, 4)
