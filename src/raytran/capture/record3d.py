# SPDX-License-Identifier: Apache-2.0
"""Record3D's exports: ``metadata.json`` and images, and the unzipped ``.r3d``.

Poses are ``[qx, qy, qz, qw, tx, ty, tz]``, camera-to-world in OpenGL axes and metres. The world is that of
the first camera: up is not known and must be measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytran.capture.lens import Lens, check_lens
from raytran.capture.names import frame_name, images_in, unlike
from raytran.capture.recording import (
    NO_LENS,
    Frame,
    FrameList,
    Intrinsics,
    Recording,
    number,
    numbers,
)
from raytran.capture.trajectory import pair_in_order, rotations
from raytran.data.images import stored_size
from raytran.data.scan import NO_IMAGE, NO_POSE
from raytran.data.text import read_json_object
from raytran.errors import DataError
from raytran.limits import MATRIX_ENTRY, PIXEL, SIDE, as_numbers

_NAMES = ("metadata.json", "metadata")
_IMAGE_FOLDERS = ("rgb", "EXR_RGBD/rgb", "rgbd")


def find_metadata(path: Path) -> Path | None:
    """Return Record3D's list of poses in a folder, or None."""
    if not any((path / name).is_dir() for name in _IMAGE_FOLDERS):
        return None
    return next((path / name for name in _NAMES if (path / name).is_file()), None)


def read_record3d(path: Path, intrinsics: Intrinsics | None = None) -> Recording:
    """Read an export of Record3D.

    Args:
        path: its folder.
        intrinsics: of the stored images, in place of the export's.

    Raises:
        DataError: a part is missing or damaged, or which image belongs to which pose cannot be told.
    """
    listed = find_metadata(path)
    if listed is None:
        raise DataError(f"{path} holds no metadata.json with rgb/ or rgbd/ beside it: export it as EXR + JPG")
    content = read_json_object(listed)
    where = str(listed)
    table = _poses(content, where)
    folder = next(path / name for name in _IMAGE_FOLDERS if (path / name).is_dir())
    images = images_in(folder)
    of_image, of_pose = pair_in_order(images, len(table), what=where, from_zero=True)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = rotations(table[:, :4])
    poses[:, :3, 3] = table[:, 4:]
    if intrinsics is None:
        lenses = _Lenses.of(content, len(table), where)
    else:
        size = stored_size(images or [folder])
        lenses = _Lenses(size, np.tile(intrinsics, (len(table), 1)), "intrinsics=")
    names = unlike([frame_name(image.name) for image in images])
    unposed = set(range(len(images))) - set(of_image)
    lone = [f"pose {i}" for i in sorted(set(range(len(table))) - set(of_pose))]
    collected = FrameList({names[i]: NO_POSE for i in unposed} | dict.fromkeys(lone, NO_IMAGE))
    for i, k in zip(of_image, of_pose, strict=True):
        with collected.sparing(names[i], NO_LENS):
            collected.frames.append(Frame(names[i], images[i], poses[k], lenses.at(k)))
    return Recording(
        path=listed,
        scene_id=path.resolve().name,
        frames=collected.checked(),
        axes="opengl",
        metric=True,
        dropped=collected.dropped,
    )


def _poses(content: dict[str, Any], where: str) -> NDArray[np.float64]:
    """Return the table of poses, ``(n, 7)``; a row that is none is not-a-number.

    Raises:
        DataError: there is none, or more than half of it is damaged.
    """
    rows = content.get("poses")
    if isinstance(rows, list):
        table = np.full((len(rows), 7), np.nan)
        for i, row in enumerate(rows):
            try:
                table[i] = as_numbers(row, (7,), MATRIX_ENTRY, f"pose {i} in {where}", lost=True)
            except DataError:
                continue
        if 2 * np.isfinite(table).all(axis=1).sum() > len(rows):
            return table
    return numbers(content, "poses", MATRIX_ENTRY, where, (-1, 7))


@dataclass(frozen=True)
class _Lenses:
    """The lens of each pose.

    Attributes:
        size: ``(H, W)`` of the images.
        table: ``(n, 4)`` fx, fy, cx, cy.
        where: name of the file in messages.
    """

    size: tuple[int, int]
    table: NDArray[np.float64]
    where: str

    @staticmethod
    def of(content: dict[str, Any], count: int, where: str) -> _Lenses:
        """Read the lenses of ``count`` poses.

        Raises:
            DataError: they are missing or damaged.
        """
        size = int(number(content, "h", SIDE, where)), int(number(content, "w", SIDE, where))
        if content.get("perFrameIntrinsicCoeffs"):
            table = numbers(content, "perFrameIntrinsicCoeffs", PIXEL, where, (count, 4))
            return _Lenses(size, table, where)
        # K is written column by column.
        matrix = numbers(content, "K", PIXEL, where, (3, 3)).T
        return _Lenses(size, np.tile(matrix[[0, 1, 0, 1], [0, 1, 2, 2]], (count, 1)), where)

    def at(self, pose: int) -> Lens:
        """Return the lens of a pose.

        Raises:
            DataError: it can be none.
        """
        fx, fy, cx, cy = self.table[pose].tolist()
        return check_lens(Lens(self.size, (fx, fy), (cx, cy)), self.where)
