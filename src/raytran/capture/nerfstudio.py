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

from raytran.capture.imported import (
    IMAGE_ENDINGS,
    Shot,
    Source,
    frame_name,
    path_inside,
    unposed_images,
)
from raytran.capture.json_file import number, numbers, read_object
from raytran.capture.lens import Lens, check_lens, opencv_lens
from raytran.data.images import stored_size
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


def read_nerfstudio(path: Path) -> Source:
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
    content = read_object(listed)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(f"{listed} lists no frames: export it again")
    undo = undo_applied(content, listed)
    images = [_image(frame, f"frame {i} of {listed}", listed) for i, frame in enumerate(frames)]
    told = all("w" in facts and "h" in facts for facts in ({**content, **frame} for frame in frames))
    size = None if told else stored_size(images)
    shots = tuple(
        _shot({**content, **frame}, image, size, undo, f"frame {i} of {listed}", _root(listed))
        for i, (frame, image) in enumerate(zip(frames, images, strict=True))
    )
    dropped = unposed_images(shots, _root(listed))
    return Source(
        path=listed, scene_id=listed.resolve().parent.name, shots=shots, axes="opengl", dropped=dropped
    )


def _image(frame: Mapping[str, Any], where: str, listed: Path) -> Path:
    """Return the path of a frame's image; one that is named without ending has the first that is there."""
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise DataError(f"{where} has no file_path: export it again")
    image = path_inside(listed.parent, name, listed)
    if image.suffix:
        return image
    return next((i for i in map(image.with_suffix, IMAGE_ENDINGS) if i.is_file()), image)


def _shot(
    facts: Mapping[str, Any],
    image: Path,
    size: tuple[int, int] | None,
    undo: NDArray[np.float64],
    where: str,
    root: Path,
) -> Shot:
    pose, lens = frame_pose(facts, undo, where), frame_lens(facts, size, where)
    return Shot(frame_name(image.relative_to(root).as_posix()), image, pose, lens)


def frame_pose(facts: Mapping[str, Any], undo: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return the pose ``(4, 4)`` of a frame, camera-to-world in OpenGL axes.

    Args:
        facts: of the frame.
        undo: what ``undo_applied`` returned.
        where: name of the frame in messages.

    Raises:
        DataError: it has no matrix of 16 numbers.
    """
    matrix = numbers(facts, "transform_matrix", where, (-1, 4))
    if matrix.shape not in ((3, 4), (4, 4)):
        raise DataError(f"{where} has a transform_matrix of {matrix.size} numbers, not 16: export it again")
    pose = np.eye(4)
    pose[:3] = undo @ np.vstack([matrix[:3], [0, 0, 0, 1]])
    # The scale undone is of the world, not of the camera's axes.
    pose[:3, :3] /= np.cbrt(abs(np.linalg.det(undo[:, :3])))
    return pose


def frame_lens(
    facts: Mapping[str, Any], size: tuple[int, int] | None, where: str, *, distorted: bool = True
) -> Lens:
    """Return the lens of a frame.

    Args:
        facts: of the frame and of all frames.
        size: ``(H, W)`` of its image, if the facts do not say.
        where: name of the frame in messages.
        distorted: False leaves the distortion of a perspective lens out.

    Raises:
        ConfigError: the lens distorts and pycolmap is not installed.
        DataError: a number is missing or odd, or the camera model is unknown.
    """
    model = str(facts.get("camera_model", "OPENCV")).upper()
    is_fisheye = bool(facts.get("is_fisheye")) or model in _FISHEYES
    if not is_fisheye and model not in (*_PINHOLES, *_PERSPECTIVE):
        raise DataError(
            f"{where} has the camera model {model}, which is not read: undistort the images to a pinhole "
            "camera and export them again"
        )
    if is_fisheye and not distorted:
        raise DataError(
            f"{where} is a fisheye, and only pinhole cameras are rendered: write camera_model PINHOLE"
        )
    if size is None or ("w" in facts and "h" in facts):
        size = int(number(facts, "h", where)), int(number(facts, "w", where))
    if min(size) < 1:
        raise DataError(f"{where} has a size of {size[1]}x{size[0]}: export it again")
    fx = _focal(facts, "fl_x", "camera_angle_x", size[1], where)
    fy = _focal(facts, "fl_y", "camera_angle_y", size[0], where) if _has_y(facts) else fx
    center = number(facts, "cx", where, size[1] / 2), number(facts, "cy", where, size[0] / 2)
    if model in _PINHOLES or not distorted:
        return check_lens(Lens(size, (fx, fy), center), where)
    k1, k2, k3, k4 = (number(facts, key, where, 0.0) for key in ("k1", "k2", "k3", "k4"))
    if is_fisheye:
        return check_lens(Lens(size, (fx, fy), center, "OPENCV_FISHEYE", (k1, k2, k3, k4)), where)
    tangential = number(facts, "p1", where, 0.0), number(facts, "p2", where, 0.0)
    return opencv_lens(size, (fx, fy), center, (k1, k2, k3, k4), tangential, where)


def _has_y(facts: Mapping[str, Any]) -> bool:
    return "fl_y" in facts or ("camera_angle_y" in facts and "fl_x" not in facts)


def _focal(facts: Mapping[str, Any], key: str, angle_key: str, side: int, where: str) -> float:
    if key in facts or angle_key not in facts:
        return number(facts, key, where)
    angle = number(facts, angle_key, where)
    if not 0 < angle < math.pi:
        raise DataError(f"{where} has {angle_key} = {angle:g}, not between 0 and pi: export it again")
    return side / (2 * math.tan(angle / 2))


def undo_applied(content: Mapping[str, Any], listed: Path) -> NDArray[np.float64]:
    """Return ``(3, 4)`` what takes the file's world back to the one before it was transformed.

    Raises:
        DataError: it cannot be taken back.
    """
    applied = np.eye(4)
    if "applied_transform" in content:
        matrix = numbers(content, "applied_transform", str(listed), (-1, 4))
        applied[:3] = matrix[:3] if len(matrix) in (3, 4) else np.nan
    applied[:3] *= number(content, "applied_scale", str(listed), 1.0)
    if not np.isfinite(applied).all() or abs(np.linalg.det(applied)) < 1e-12:
        raise DataError(f"applied_transform in {listed} cannot be undone: remove it or export it again")
    return np.asarray(np.linalg.inv(applied)[:3], dtype=np.float64)


def _root(listed: Path) -> Path:
    return Path(os.path.abspath(listed.parent))
