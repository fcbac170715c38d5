# SPDX-License-Identifier: Apache-2.0
"""Logs of Apple's ARKit: of the apps 3D Scanner App and Polycam, and of the data set ARKitScenes.

The apps write camera-to-world matrices row by row in OpenGL axes, +y up; ARKitScenes camera-from-world
rotations and translations in OpenCV axes, +z up. All are in metres. A phone held upright gives images that
lie on their side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from raytran.capture.lens import Lens, check_lens
from raytran.capture.names import frame_name, images_in, is_hidden, unlike
from raytran.capture.recording import (
    NO_ENTRY,
    NO_LENS,
    Frame,
    FrameList,
    Intrinsics,
    Recording,
    number,
    numbers,
    typed_lens,
)
from raytran.capture.trajectory import NO_TIME, Track, poses_at, read_rows
from raytran.data.images import stored_size
from raytran.data.scan import NO_IMAGE, NO_MATRIX, NO_POSE, numbers_first
from raytran.data.text import read_json_object, read_table
from raytran.errors import DataError
from raytran.limits import FOCAL_LENGTH, MATRIX_ENTRY, MAX_SIDE, PIXEL, SIDE, as_count

_TRACKS = {
    "lowres_wide.traj": (
        ("lowres_wide", "lowres_wide_intrinsics"),
        ("vga_wide", "vga_wide_intrinsics"),
        ("wide", "wide_intrinsics"),
    ),
    "color.traj": (("wide", "color_intrinsics"),),
}
"""ARKitScenes' tracks → the folders of images that they fit, the ones to prefer first, and of their
intrinsics."""

_POLYCAM = (
    ("keyframes/corrected_cameras", "keyframes/corrected_images"),
    ("keyframes/cameras", "keyframes/images"),
)
"""Polycam's folders of JSON files and of images, the ones to prefer first."""

_PoseReader = Callable[[Mapping[str, Any], Path], NDArray[np.float64]]
"""Returns the pose ``(4, 4)`` in a JSON file's content."""

_LensReader = Callable[[Mapping[str, Any], Path, tuple[int, int]], Lens]
"""Returns the lens in a JSON file's content, for images of a size ``(H, W)``."""

_MAX_APART = 0.06
"""Seconds between an image and its intrinsics, which like the poses may come ten times a second."""


def find_log(path: Path) -> Path | None:
    """Return the track, or the folder of JSON files, of a recording; None if ``path`` holds none."""
    if not path.is_dir():
        return None
    for folder in (path, *_visible(path, "*_frames")):
        for name in _TRACKS:
            if (folder / name).is_file():
                return folder / name
    pairs = [(path / cameras, path / images) for cameras, images in _POLYCAM]
    pairs = [(cameras, images) for cameras, images in pairs if cameras.is_dir() and images.is_dir()]
    # A capture that the app did not optimise has empty folders for what it would have corrected.
    filled = [cameras for cameras, images in pairs if _visible(cameras, "*.json") and images_in(images)]
    if pairs:
        return filled[0] if filled else pairs[0][0]
    return path if _visible(path, "frame_*.json") else None


def _visible(folder: Path, pattern: str) -> list[Path]:
    """Return the files in a folder that fit a pattern, without those that macOS puts beside them."""
    return sorted(path for path in folder.glob(pattern) if not is_hidden(path.name))


def read_arkit(path: Path, intrinsics: Intrinsics | None = None) -> Recording:
    """Read a recording of 3D Scanner App ("all data"), Polycam ("raw data") or ARKitScenes.

    Args:
        path: its folder.
        intrinsics: of the stored images, in place of the recording's.

    Raises:
        DataError: it is none of them, or a part is missing or damaged.
    """
    log = find_log(path)
    if log is None:
        raise DataError(
            f"{path} holds no ARKit log: wanted are frame_*.json with frame_*.jpg (3D Scanner App), "
            "keyframes/cameras with keyframes/images (Polycam), or lowres_wide.traj (ARKitScenes)"
        )
    scene_id = path.resolve().name
    if log.is_file():
        return _read_arkitscenes(log, scene_id, intrinsics)
    if log == path:
        return _read_app(log, path, scene_id, _scanner_pose, _scanner_lens, intrinsics)
    images = next(path / images for cameras, images in _POLYCAM if path / cameras == log)
    return _read_app(log, images, scene_id, _polycam_pose, _polycam_lens, intrinsics)


def _read_app(
    log: Path,
    folder: Path,
    scene_id: str,
    read_pose: _PoseReader,
    read_lens: _LensReader,
    intrinsics: Intrinsics | None,
) -> Recording:
    """Read one JSON file per image; an image without one is dropped, and the other way round."""
    images = {image.stem: image for image in images_in(folder)}
    logs = {entry.stem: entry for entry in _visible(log, "*.json")}
    if log == folder:
        logs = {stem: entry for stem, entry in logs.items() if stem.startswith("frame_")}
        images = {stem: image for stem, image in images.items() if stem.startswith("frame_")}
    both = sorted(images.keys() & logs.keys(), key=numbers_first)
    collected = FrameList({stem: NO_POSE for stem in images.keys() - logs.keys()})
    collected.dropped |= {stem: NO_IMAGE for stem in logs.keys() - images.keys()}
    size = stored_size([images[stem] for stem in both] or [log])
    typed = None if intrinsics is None else typed_lens(intrinsics, size)
    for stem in both:
        file = logs[stem]
        with collected.sparing(stem, NO_ENTRY):
            content = read_json_object(file)
            with collected.sparing(stem, NO_MATRIX):
                pose = read_pose(content, file)
                with collected.sparing(stem, NO_LENS):
                    lens = typed or read_lens(content, file, size)
                    collected.frames.append(Frame(frame_name(images[stem].name), images[stem], pose, lens))
    return Recording(
        path=log,
        scene_id=scene_id,
        frames=collected.checked(),
        axes="opengl",
        up=(0.0, 1.0, 0.0),
        metric=True,
        dropped=collected.dropped,
    )


def _scanner_pose(content: Mapping[str, Any], file: Path) -> NDArray[np.float64]:
    return numbers(content, "cameraPoseARFrame", MATRIX_ENTRY, str(file), (4, 4))


def _scanner_lens(content: Mapping[str, Any], file: Path, size: tuple[int, int]) -> Lens:
    matrix = numbers(content, "intrinsics", PIXEL, str(file), (3, 3))
    lens = Lens(size, (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]))
    return check_lens(lens, str(file))


def _polycam_pose(content: Mapping[str, Any], file: Path) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3] = [
        [number(content, f"t_{row}{column}", MATRIX_ENTRY, str(file)) for column in range(4)]
        for row in range(3)
    ]
    return pose


def _polycam_lens(content: Mapping[str, Any], file: Path, size: tuple[int, int]) -> Lens:
    where = str(file)
    fx, fy = (number(content, key, FOCAL_LENGTH, where) for key in ("fx", "fy"))
    cx, cy = (number(content, key, PIXEL, where) for key in ("cx", "cy"))
    return check_lens(Lens(_polycam_size(content, file, size), (fx, fy), (cx, cy)), where)


def _polycam_size(content: Mapping[str, Any], file: Path, size: tuple[int, int]) -> tuple[int, int]:
    """Return the size ``(H, W)`` that intrinsics are for.

    Since 2025 the corrected cameras do not say: it is that of the camera before it was corrected, or else of
    the images.
    """
    before = file.parents[1] / "cameras" / file.name
    if not {"width", "height"} <= content.keys() and before != file and before.is_file():
        content = read_json_object(before)
    if not {"width", "height"} <= content.keys():
        return size
    height, width = (int(number(content, key, SIDE, str(file))) for key in ("height", "width"))
    return height, width


def _read_arkitscenes(listed: Path, scene_id: str, intrinsics: Intrinsics | None) -> Recording:
    """Read a track; each image gets the pose at its time and the nearest intrinsics."""
    table = read_rows(listed)
    if table.ndim != 2 or table.shape[1] != 7:
        raise DataError(f"{listed} does not hold a time, a turn and a shift in each line: download it again")
    table = table[np.isfinite(table).all(axis=1)]
    times, order = np.unique(table[:, 0], return_index=True)
    poses = np.tile(np.eye(4), (len(order), 1, 1))
    rotation = Rotation.from_rotvec(table[order, 1:4]).as_matrix().swapaxes(1, 2)
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = -(rotation @ table[order, 4:, None])[..., 0]
    folder, cameras = _folders_of(listed)
    images = images_in(folder)
    names = unlike([frame_name(image.name) for image in images])
    collected = FrameList()
    pincams = _Pincams(cameras)
    typed = None if intrinsics is None else typed_lens(intrinsics, stored_size(images or [folder]))
    image_times = np.array([_time(image) for image in images])
    image_poses = poses_at(Track(listed, times, poses), image_times)
    for name, image, time, pose in zip(names, images, image_times.tolist(), image_poses, strict=True):
        if not np.isfinite(time):
            collected.dropped[name] = NO_TIME
        elif not np.isfinite(pose).all():
            collected.dropped[name] = NO_POSE
        else:
            with collected.sparing(name, NO_LENS):
                lens = typed or pincams.at(time)
                if lens is None:
                    collected.dropped[name] = NO_POSE
                else:
                    collected.frames.append(Frame(name, image, pose, lens))
    return Recording(
        path=listed,
        scene_id=scene_id,
        frames=collected.checked(),
        up=(0.0, 0.0, 1.0),
        metric=True,
        dropped=collected.dropped,
    )


def _folders_of(listed: Path) -> tuple[Path, Path]:
    """Return the folder of images that a track fits, and that of their intrinsics.

    Raises:
        DataError: there are none.
    """
    pairs = [tuple(listed.parent / name for name in names) for names in _TRACKS[listed.name]]
    images = next((folder for folder, _ in pairs if folder.is_dir()), None)
    if images is None:
        wanted = " or ".join(folder.name for folder, _ in pairs)
        raise DataError(f"{listed.parent} has no folder {wanted} of images: download one of them")
    own = [cameras for folder, cameras in pairs if folder == images]
    # Images of one lens: those of another size will do, since intrinsics say theirs.
    cameras = next((folder for folder in (*own, *(c for _, c in pairs)) if folder.is_dir()), None)
    if cameras is None:
        raise DataError(f"{listed.parent} has no folder {own[0].name}: download it again")
    return images, cameras


class _Pincams:
    """The intrinsics of ARKitScenes, a file each.

    Raises:
        DataError: the folder holds none.
    """

    def __init__(self, folder: Path) -> None:
        files = [(_time(file), file) for file in _visible(folder, "*.pincam")]
        self._files = [file for time, file in files if np.isfinite(time)]
        self._times = np.array([time for time, _ in files if np.isfinite(time)])
        if not self._files:
            raise DataError(f"{folder} holds no .pincam files: download it again")

    def at(self, time: float) -> Lens | None:
        """Return the lens at a time in seconds, None if no file is near.

        Raises:
            DataError: it is damaged.
        """
        nearest = int(np.abs(self._times - time).argmin())
        if abs(self._times[nearest] - time) > _MAX_APART:
            return None
        path = self._files[nearest]
        values = read_table(path)
        if values.size != 6:
            raise DataError(f"{path} does not hold `width height fx fy cx cy`: download it again")
        width, height, fx, fy, cx, cy = values.ravel().tolist()
        rows = as_count(height, 1, MAX_SIDE, f"the height in {path}")
        columns = as_count(width, 1, MAX_SIDE, f"the width in {path}")
        return check_lens(Lens((rows, columns), (fx, fy), (cx, cy)), str(path))


def _time(path: Path) -> float:
    """Return the time in a name such as ``41254925_3211.498.png``, seconds; not-a-number if there is none."""
    try:
        return float(path.stem.rpartition("_")[2])
    except ValueError:
        return math.nan
