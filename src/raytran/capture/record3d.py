# SPDX-License-Identifier: Apache-2.0
"""Record3D's exports: ``metadata.json`` and images, and the unzipped ``.r3d``.

Poses are ``[qx, qy, qz, qw, tx, ty, tz]``, camera-to-world in OpenGL axes and metres. The world is that of
the first camera: up is not known and must be measured.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from raytran.capture.lens import Lens, check_lens
from raytran.capture.recording import Frame, Recording, frame_name, images_in, number, numbers, read_json
from raytran.capture.trajectory import rotations
from raytran.errors import DataError

_NAMES = ("metadata.json", "metadata")
_IMAGE_FOLDERS = ("rgb", "EXR_RGBD/rgb", "rgbd")


def find_metadata(path: Path) -> Path | None:
    """Return Record3D's list of poses in a folder, or None."""
    if not any((path / name).is_dir() for name in _IMAGE_FOLDERS):
        return None
    return next((path / name for name in _NAMES if (path / name).is_file()), None)


def read_record3d(path: Path) -> Recording:
    """Read an export of Record3D.

    Raises:
        DataError: a part is missing or damaged, or there are not as many images as poses.
    """
    if path.suffix.lower() == ".r3d":
        raise DataError(f"{path} is a packed recording: unzip it and give the folder")
    listed = find_metadata(path)
    if listed is None:
        raise DataError(f"{path} holds no metadata.json with rgb/ or rgbd/ beside it: export it as EXR + JPG")
    content = read_json(listed)
    where = str(listed)
    table = numbers(content, "poses", where, (-1, 7))
    folder = next(path / name for name in _IMAGE_FOLDERS if (path / name).is_dir())
    images = images_in(folder)
    if len(images) != len(table):
        raise DataError(
            f"{listed} has {len(table)} poses and {folder} {len(images)} images: export both again"
        )
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = rotations(table[:, :4])
    poses[:, :3, 3] = table[:, 4:]
    lenses = _lenses(content, len(table), where)
    frames = (
        Frame(frame_name(image.name), image, pose, lens)
        for image, pose, lens in zip(images, poses, lenses, strict=True)
    )
    return Recording(
        path=listed, scene_id=path.resolve().name, frames=tuple(frames), axes="opengl", metric=True
    )


def _lenses(content: dict[str, Any], count: int, where: str) -> list[Lens]:
    size = int(number(content, "h", where)), int(number(content, "w", where))
    if content.get("perFrameIntrinsicCoeffs"):
        table = numbers(content, "perFrameIntrinsicCoeffs", where, (count, 4))
    else:
        # K is written column by column.
        matrix = numbers(content, "K", where, (3, 3)).T
        table = np.tile(matrix[[0, 1, 0, 1], [0, 1, 2, 2]], (count, 1))
    return [check_lens(Lens(size, (fx, fy), (cx, cy)), where) for fx, fy, cx, cy in table.tolist()]
