# SPDX-License-Identifier: Apache-2.0
"""nerfstudio's ``transforms.json``, also as instant-ngp and synthetic data sets write it.

Format: nerfstudio's documentation, "Data conventions". Poses are camera-to-world in OpenGL axes, of a world
to which ``applied_transform`` and then ``applied_scale`` were applied; both are undone.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytran.capture.lens import Lens, check_lens, opencv_lens
from raytran.capture.recording import (
    Frame,
    Recording,
    frame_name,
    number,
    numbers,
    path_inside,
    read_json,
    unposed_images,
)
from raytran.data.images import IMAGE_ENDINGS, stored_size
from raytran.errors import DataError

NAMES = ("transforms.json", "transforms_train.json")

_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
_PERSPECTIVE = ("OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


def find_transforms(path: Path) -> Path | None:
    """Return the list of frames that ``path`` is or holds, or None."""
    if path.is_file():
        return path if path.suffix.lower() == ".json" else None
    return next((path / name for name in NAMES if (path / name).is_file()), None)


def read_nerfstudio(path: Path) -> Recording:
    """Read a ``transforms.json``.

    Args:
        path: the file or its folder.

    Raises:
        ConfigError: its lens distorts and pycolmap is not installed.
        DataError: it is missing, damaged, lists no frames, or names images outside its folder.
    """
    listed = find_transforms(path)
    if listed is None:
        raise DataError(f"{path} holds no {NAMES[0]}: give the folder that ns-process-data wrote")
    content = read_json(listed)
    entries = content.get("frames")
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(f"{listed} lists no frames: export it again")
    undo = undo_applied(content, listed)
    root = Path(os.path.abspath(listed.parent))
    images = [_image(entry, f"frame {i} of {listed}", listed) for i, entry in enumerate(entries)]
    # What all frames share stands beside the list.
    entries = [{**content, **entry} for entry in entries]
    has_size = all("w" in entry and "h" in entry for entry in entries)
    size = None if has_size else stored_size(images)
    frames = []
    for i, (entry, image) in enumerate(zip(entries, images, strict=True)):
        where = f"frame {i} of {listed}"
        name = frame_name(image.relative_to(root).as_posix())
        lens = frame_lens(entry, size, where)
        frames.append(Frame(name, image, frame_pose(entry, undo, where), lens))
    return Recording(
        path=listed,
        scene_id=listed.resolve().parent.name,
        frames=tuple(frames),
        axes="opengl",
        dropped=unposed_images(frames, root),
    )


def _image(entry: Mapping[str, Any], where: str, listed: Path) -> Path:
    """Return the path of a frame's image; a name without ending gets that of the first file that exists."""
    name = entry.get("file_path")
    if not isinstance(name, str) or not name:
        raise DataError(f"{where} has no file_path: export it again")
    image = path_inside(listed.parent, name, listed)
    if image.suffix:
        return image
    return next((i for i in map(image.with_suffix, IMAGE_ENDINGS) if i.is_file()), image)


def frame_pose(entry: Mapping[str, Any], undo: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return the pose ``(4, 4)`` of a frame, camera-to-world in OpenGL axes.

    Args:
        entry: of the frame in the list, with what all frames share.
        undo: what ``undo_applied`` returned.
        where: name of the frame in messages.

    Raises:
        DataError: it has no matrix of 16 numbers.
    """
    matrix = numbers(entry, "transform_matrix", where, (-1, 4))
    if matrix.shape not in ((3, 4), (4, 4)):
        raise DataError(f"{where} has a transform_matrix of {matrix.size} numbers, not 16: export it again")
    pose = np.eye(4)
    pose[:3] = undo @ np.vstack([matrix[:3], [0, 0, 0, 1]])
    # Rotations keep length one: the undone scale is of the world, not of the camera's axes.
    pose[:3, :3] /= np.cbrt(abs(np.linalg.det(undo[:, :3])))
    return pose


def frame_lens(
    entry: Mapping[str, Any], size: tuple[int, int] | None, where: str, *, distorted: bool = True
) -> Lens:
    """Return the lens of a frame.

    Args:
        entry: of the frame in the list, with what all frames share.
        size: ``(H, W)`` of its image, if the entry does not say.
        where: name of the frame in messages.
        distorted: False leaves the distortion of a perspective lens out.

    Raises:
        ConfigError: the lens distorts and pycolmap is not installed.
        DataError: a number is missing or odd, or the camera model is unknown.
    """
    model = str(entry.get("camera_model", "OPENCV")).upper()
    is_fisheye = bool(entry.get("is_fisheye")) or model in _FISHEYES
    if not is_fisheye and model not in (*_PINHOLES, *_PERSPECTIVE):
        raise DataError(
            f"{where} has the camera model {model}, which is not read: undistort the images to a pinhole "
            "camera and export them again"
        )
    if is_fisheye and not distorted:
        raise DataError(
            f"{where} is a fisheye, and only pinhole cameras are rendered: write camera_model PINHOLE"
        )
    if size is None or ("w" in entry and "h" in entry):
        size = int(number(entry, "h", where)), int(number(entry, "w", where))
    if min(size) < 1:
        raise DataError(f"{where} has a size of {size[1]}x{size[0]}: export it again")
    fx = _focal(entry, "fl_x", "camera_angle_x", size[1], where)
    fy = _focal(entry, "fl_y", "camera_angle_y", size[0], where) if _has_y(entry) else fx
    center = number(entry, "cx", where, size[1] / 2), number(entry, "cy", where, size[0] / 2)
    if model in _PINHOLES or not distorted:
        return check_lens(Lens(size, (fx, fy), center), where)
    k1, k2, k3, k4 = (number(entry, key, where, 0.0) for key in ("k1", "k2", "k3", "k4"))
    if is_fisheye:
        return check_lens(Lens(size, (fx, fy), center, "OPENCV_FISHEYE", (k1, k2, k3, k4)), where)
    tangential = number(entry, "p1", where, 0.0), number(entry, "p2", where, 0.0)
    return opencv_lens(size, (fx, fy), center, (k1, k2, k3, k4), tangential, where)


def _has_y(entry: Mapping[str, Any]) -> bool:
    return "fl_y" in entry or ("camera_angle_y" in entry and "fl_x" not in entry)


def _focal(entry: Mapping[str, Any], key: str, angle_key: str, side: int, where: str) -> float:
    if key in entry or angle_key not in entry:
        return number(entry, key, where)
    angle = number(entry, angle_key, where)
    if not 0 < angle < math.pi:
        raise DataError(f"{where} has {angle_key} = {angle:g}, not between 0 and pi: export it again")
    return side / (2 * math.tan(angle / 2))


def undo_applied(content: Mapping[str, Any], listed: Path) -> NDArray[np.float64]:
    """Return the inverse ``(3, 4)`` of the transform and scale that were applied to the file's world.

    Raises:
        DataError: they have no inverse.
    """
    applied = np.eye(4)
    if "applied_transform" in content:
        matrix = numbers(content, "applied_transform", str(listed), (-1, 4))
        applied[:3] = matrix[:3] if len(matrix) in (3, 4) else np.nan
    applied[:3] *= number(content, "applied_scale", str(listed), 1.0)
    if not np.isfinite(applied).all() or abs(np.linalg.det(applied)) < 1e-12:
        raise DataError(f"applied_transform in {listed} cannot be undone: remove it or export it again")
    return np.asarray(np.linalg.inv(applied)[:3], dtype=np.float64)
