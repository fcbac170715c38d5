# SPDX-License-Identifier: Apache-2.0
"""Frames of a scan in the prepared form: few, small, whole, under the number they had in the video."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from raytran.data.scan import OpenScan
from raytran.data.views import choose_even
from raytran.errors import DataError

JPEG_QUALITY = 90
"""Of frames that were resized; ones that have the right size already keep their bytes."""

_PNG = b"\x89PNG"


def frame_names(frame_ids: Sequence[str]) -> list[str]:
    """Return the number in each frame's name, ``000010`` becomes ``10``; the names if two have the same."""
    numbers = [re.findall(r"\d+", name) for name in frame_ids]
    plain = [str(int(found[-1])) if found else name for found, name in zip(numbers, frame_ids, strict=True)]
    return plain if len(set(plain)) == len(plain) else list(frame_ids)


def choose_frames(count: int, max_frames: int | None) -> list[int]:
    """Return the positions of at most ``max_frames`` evenly spread ones of ``count`` frames."""
    if max_frames is None or count <= max_frames:
        return list(range(count))
    return choose_even(count, max_frames).tolist()


def nearest_first(position: int, count: int) -> Iterator[int]:
    """Yield the positions from 0 to ``count`` - 1, those near ``position`` first."""
    yield from sorted(range(count), key=lambda other: (abs(other - position), other))


def encoded_frame(scan: OpenScan, position: int, image_size: tuple[int, int]) -> tuple[bytes, str]:
    """Return a frame of the prepared size and its ending, ``.jpg`` or ``.png``.

    A stored frame that has the size already comes as it is, after it was decoded to see that it is whole.

    Args:
        scan: an open scan.
        position: of the frame in it.
        image_size: ``(H, W)``.

    Raises:
        DataError: the frame is truncated, damaged, or of another size than the others.
    """
    stored = scan.color_bytes(position) if scan.image_size == image_size else None
    if stored is not None:
        scan.read_color(position)
        return stored, ".png" if stored.startswith(_PNG) else ".jpg"
    file = BytesIO()
    Image.fromarray(scan.read_color(position, image_size)).save(file, "JPEG", quality=JPEG_QUALITY)
    return file.getvalue(), ".jpg"


def write_frames(
    scan: OpenScan, folder: Path, *, image_size: tuple[int, int], max_frames: int | None
) -> tuple[list[int], dict[str, str]]:
    """Write the chosen frames and their poses; a damaged frame is replaced by the nearest one left.

    Args:
        scan: an open scan.
        folder: of the prepared scan; gets ``color/`` and ``pose/``.
        image_size: ``(H, W)``.
        max_frames: at most so many, evenly spread; None for all.

    Returns:
        the positions that were written, ascending, and what is wrong with each damaged one, by its name.
    """
    (folder / "color").mkdir()
    (folder / "pose").mkdir()
    names = frame_names(scan.frame_id)
    damaged: dict[int, str] = {}
    taken: set[int] = set()
    chosen = choose_frames(len(names), max_frames)
    reserved = set(chosen)

    def write(position: int) -> bool:
        try:
            content, ending = encoded_frame(scan, position, image_size)
        except DataError as error:
            damaged[position] = str(error)
            return False
        (folder / "color" / f"{names[position]}{ending}").write_bytes(content)
        pose = matrix_text(scan.world_from_camera[position])
        (folder / "pose" / f"{names[position]}.txt").write_text(pose, encoding="ascii")
        taken.add(position)
        return True

    for position in chosen:
        if not write(position):
            spare = (p for p in nearest_first(position, len(names)) if p not in reserved and p not in damaged)
            next((p for p in spare if p not in taken and write(p)), None)
    return sorted(taken), {scan.frame_id[p]: damaged[p] for p in sorted(damaged)}


def matrix_text(matrix: Tensor) -> str:
    """Return a matrix as lines of numbers that read back as the same float64."""
    return "".join(" ".join(repr(value) for value in row) + "\n" for row in matrix.double().tolist())


def homogeneous(intrinsics: Tensor) -> Tensor:
    """Return ``(3, 3)`` intrinsics as the 4×4 of ScanNet's files."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = intrinsics
    return matrix
