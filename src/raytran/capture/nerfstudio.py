# SPDX-License-Identifier: Apache-2.0
"""nerfstudio's ``transforms.json``, also as instant-ngp, synthetic data sets and ScanNet++ write it.

Format: nerfstudio's documentation, "Data conventions". Poses are camera-to-world in OpenGL axes, of a world
to which ``applied_transform`` and then ``applied_scale`` were applied; both are undone. ScanNet++ keeps the
lists in ``dslr/nerfstudio`` and the images beside that folder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytran.capture.lens import Lens, check_lens, opencv_lens
from raytran.capture.names import frame_name, locate, unlike, unposed_images
from raytran.capture.recording import (
    NO_LENS,
    Frame,
    FrameList,
    Intrinsics,
    Recording,
    number,
    numbers,
    typed_lens,
)
from raytran.data.images import stored_size
from raytran.data.scan import NO_MATRIX
from raytran.data.text import read_json_object
from raytran.errors import DataError
from raytran.limits import ANGLE, DISTORTION, FOCAL_LENGTH, MATRIX_ENTRY, PIXEL, SCALE, SIDE

NAMES = ("transforms.json", "transforms_train.json")

_SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
"""Files that share the frames of one walk between them."""

_SCANNETPP = {
    "transforms_undistorted.json": ("resized_undistorted_images", "undistorted_images"),
    "transforms.json": ("resized_images", "images", "rgb"),
}
"""ScanNet++'s lists, the one to prefer first, and the folders of their images beside the lists' folder."""

_PLACES = (".", "nerfstudio", "dslr/nerfstudio", "iphone/nerfstudio")
_PARTS_OF_PLACES = ("nerfstudio", "dslr", "iphone")

WORLD, WORLD_UP, WORLD_METRES = "raytran_world", "+z", "metre"
"""Key beside the list under which ``raytran poses`` says ``up`` and ``unit``; what they are if it is sure."""

BAD = "marked as bad"
"""Reason why a frame is dropped: ScanNet++ marks blurred images with ``is_bad``."""

_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
_PERSPECTIVE = ("OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


def find_transforms(path: Path) -> Path | None:
    """Return the list of frames that ``path`` is or holds, or None."""
    if path.is_file():
        return path if path.suffix.lower() == ".json" else None
    for place in _PLACES:
        folder = path / place
        names = (*_SCANNETPP, *NAMES) if folder.resolve().name == "nerfstudio" else (*NAMES, *_SCANNETPP)
        lists = [folder / name for name in names if (folder / name).is_file()]
        if lists:
            with_images = (listed for listed in lists if len(lists) == 1 or _images_beside(listed))
            return next(with_images, lists[0])
    return None


def _images_beside(listed: Path) -> Path | None:
    """Return ScanNet++'s folder of images for a list, or None."""
    folder = Path(os.path.abspath(listed)).parent
    names = _SCANNETPP.get(listed.name, ()) if folder.name == "nerfstudio" else ()
    return next((folder.parent / name for name in names if (folder.parent / name).is_dir()), None)


def read_nerfstudio(path: Path, intrinsics: Intrinsics | None = None) -> Recording:
    """Read a ``transforms.json``, or the lists for training, validation and test that lie beside each other.

    Frames that ScanNet++ keeps for tests are as good for a prediction as others.

    Args:
        path: the file or its folder.
        intrinsics: of the stored images, in place of the list's.

    Raises:
        ConfigError: its lens distorts and pycolmap is not installed.
        DataError: it is missing, damaged, lists no frames, or names images outside its folder.
    """
    listed = find_transforms(path)
    if listed is None:
        raise DataError(f"{path} holds no {NAMES[0]}: give the folder that ns-process-data wrote")
    lists = [listed]
    if path.is_dir() and listed.name in _SPLITS:
        lists = [listed.with_name(name) for name in _SPLITS if listed.with_name(name).is_file()]
    entries = _without_repeats([entry for file in lists for entry in _entries(file)])
    root = Path(os.path.abspath(_images_beside(listed) or listed.parent))
    located = locate([entry.image for entry in entries], root)
    located.report(listed, root)
    names = unlike([
        frame_name(place.relative_to(root).as_posix() if isinstance(place, Path) else entry.image)
        if entry.image
        else entry.where.partition(" of ")[0]
        for entry, place in zip(entries, located.places, strict=True)
    ])  # fmt: skip
    placed = [place for place in located.places if isinstance(place, Path)]
    has_size = all("w" in entry.content and "h" in entry.content for entry in entries)
    size = stored_size(placed or [listed]) if intrinsics is not None or not has_size else None
    typed = None if intrinsics is None or size is None else typed_lens(intrinsics, size)
    collected = FrameList()
    for name, entry, place in zip(names, entries, located.places, strict=True):
        if entry.content.get("is_bad") is True or isinstance(place, str):
            collected.dropped[name] = place if isinstance(place, str) else BAD
            continue
        with collected.sparing(name, NO_MATRIX):
            pose = frame_pose(entry.content, entry.undo, entry.where)
            with collected.sparing(name, NO_LENS):
                lens = typed or frame_lens(entry.content, size, entry.where)
                collected.frames.append(Frame(name, place, pose, lens))
    collected.dropped |= unposed_images(placed, root, names)
    return Recording(
        path=listed,
        scene_id=_scene_name(listed),
        frames=collected.checked(),
        axes="opengl",
        up=(0.0, 0.0, 1.0) if all(_says(entry, "up", WORLD_UP) for entry in entries) else None,
        metric=all(_says(entry, "unit", WORLD_METRES) for entry in entries),
        dropped=collected.dropped,
    )


def _says(entry: _Entry, key: str, value: str) -> bool:
    """Whether the list of a frame promises something of its world."""
    world = entry.content.get(WORLD)
    return isinstance(world, dict) and world.get(key) == value


@dataclass(frozen=True)
class _Entry:
    """A frame of a list.

    Attributes:
        where: name of the frame in messages.
        content: its values, and what all frames of the list share.
        undo: see ``undo_applied``.
        image: name of its image, empty if it has none.
    """

    where: str
    content: Mapping[str, Any]
    undo: NDArray[np.float64]
    image: str


def _entries(listed: Path) -> list[_Entry]:
    """Return the frames of a list, those that ScanNet++ keeps for tests among them.

    Raises:
        DataError: it is no list of frames.
    """
    content = read_json_object(listed)
    frames = content.get("frames")
    if not isinstance(frames, list) or not any(isinstance(frame, dict) for frame in frames):
        raise DataError(f"{listed} lists no frames: export it again")
    kept = content.get("test_frames")
    undo = undo_applied(content, listed)
    entries = []
    for i, frame in enumerate([*frames, *(kept if isinstance(kept, list) else ())]):
        values = frame if isinstance(frame, dict) else {}
        name = values.get("file_path")
        # What all frames share stands beside the list.
        entries.append(
            _Entry(
                f"frame {i} of {listed}", {**content, **values}, undo, name if isinstance(name, str) else ""
            )
        )
    if not any(entry.image for entry in entries):
        raise DataError(f"frame 0 of {listed} has no file_path: export it again")
    return entries


def _without_repeats(entries: list[_Entry]) -> list[_Entry]:
    """Return the frames without those that a second list, or the list of tests, has once more."""
    seen: set[tuple[str, str]] = set()
    once = []
    for entry in entries:
        key = (entry.image, repr(entry.content.get("transform_matrix")))
        if key not in seen or not entry.image:
            once.append(entry)
        seen.add(key)
    return once


def _scene_name(listed: Path) -> str:
    """Return the name of the first folder that is not one in which ScanNet++ keeps a part of a scene."""
    folders = listed.resolve().parents
    return next((folder.name for folder in folders if folder.name not in _PARTS_OF_PLACES), "scene")


def frame_pose(entry: Mapping[str, Any], undo: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return the pose ``(4, 4)`` of a frame, camera-to-world in OpenGL axes.

    Args:
        entry: of the frame in the list, with what all frames share.
        undo: what ``undo_applied`` returned.
        where: name of the frame in messages.

    Raises:
        DataError: it has no matrix of 16 numbers.
    """
    matrix = numbers(entry, "transform_matrix", MATRIX_ENTRY, where, (-1, 4))
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
        size = int(number(entry, "h", SIDE, where)), int(number(entry, "w", SIDE, where))
    if min(size) < 1:
        raise DataError(f"{where} has a size of {size[1]}x{size[0]}: export it again")
    fx = _focal(entry, "fl_x", "camera_angle_x", size[1], where)
    fy = _focal(entry, "fl_y", "camera_angle_y", size[0], where) if _has_y(entry) else fx
    cx = number(entry, "cx", PIXEL, where, size[1] / 2)
    center = cx, number(entry, "cy", PIXEL, where, size[0] / 2)
    if not distorted:
        return check_lens(Lens(size, (fx, fy), center), where)
    # Whatever the camera model: nerfstudio, too, removes the distortion of a PINHOLE that has one.
    k1, k2, k3, k4, p1, p2 = _distortion(entry, where)
    if is_fisheye:
        return check_lens(Lens(size, (fx, fy), center, "OPENCV_FISHEYE", (k1, k2, k3, k4)), where)
    return opencv_lens(size, (fx, fy), center, (k1, k2, k3, k4), (p1, p2), where)


def _distortion(entry: Mapping[str, Any], where: str) -> list[float]:
    """Return k1, k2, k3, k4, p1, p2: ``distortion_params`` in this order, or one by one; 0 if not given."""
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    if entry.get("distortion_params") is None:
        return [number(entry, name, DISTORTION, where, 0.0) for name in names]
    params = numbers(entry, "distortion_params", DISTORTION, where, (-1,)).tolist()
    # Of fewer than six nobody knows whether the third is k3, as here, or p1, as in OpenCV.
    if len(params) > len(names) or (len(params) < len(names) and any(params[2:])):
        raise DataError(
            f"{where} has {len(params)} distortion_params, not k1, k2, k3, k4, p1, p2: export it again"
        )
    return params + [0.0] * (len(names) - len(params))


def _has_y(entry: Mapping[str, Any]) -> bool:
    return "fl_y" in entry or ("camera_angle_y" in entry and "fl_x" not in entry)


def _focal(entry: Mapping[str, Any], key: str, angle_key: str, side: int, where: str) -> float:
    if key in entry or angle_key not in entry:
        return number(entry, key, FOCAL_LENGTH, where)
    angle = number(entry, angle_key, ANGLE, where)
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
        matrix = numbers(content, "applied_transform", MATRIX_ENTRY, str(listed), (-1, 4))
        applied[:3] = matrix[:3] if len(matrix) in (3, 4) else np.nan
    applied[:3] *= number(content, "applied_scale", SCALE, str(listed), 1.0)
    if not np.isfinite(applied).all() or abs(np.linalg.det(applied)) < 1e-12:
        raise DataError(f"applied_transform in {listed} cannot be undone: remove it or export it again")
    return np.asarray(np.linalg.inv(applied)[:3], dtype=np.float64)
