# SPDX-License-Identifier: Apache-2.0
"""Logs of Apple's ARKit: of the apps 3D Scanner App and Polycam, and of the data set ARKitScenes.

The apps write camera-to-world matrices row by row in OpenGL axes, +y up; ARKitScenes camera-from-world
rotations and translations in OpenCV axes, +z up. All are in metres. A phone held upright gives images that
lie on their side.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from raytran.capture.lens import Lens, check_lens
from raytran.capture.recording import Frame, Recording, frame_name, images_in, number, numbers, read_json
from raytran.capture.trajectory import Track, poses_at, read_table
from raytran.data.images import stored_size
from raytran.data.scan import NO_IMAGE, NO_POSE, numbers_first
from raytran.errors import DataError

_TRACKS = {
    "lowres_wide.traj": ("lowres_wide", "lowres_wide_intrinsics"),
    "color.traj": ("wide", "color_intrinsics"),
}
"""ARKitScenes' tracks → their folders of images and of intrinsics."""

_POLYCAM = (
    ("keyframes/corrected_cameras", "keyframes/corrected_images"),
    ("keyframes/cameras", "keyframes/images"),
)
"""Polycam's folders of JSON files and of images, the ones to prefer first."""

_FrameReader = Callable[[Mapping[str, Any], Path, tuple[int, int], str], Frame]
"""Makes a frame of a JSON file's content, its image, the size of the images, and the file's name."""

_MAX_APART = 0.02
"""Seconds between an image and its intrinsics."""


def find_log(path: Path) -> Path | None:
    """Return the track, or the folder of JSON files, of a recording; None if ``path`` holds none."""
    if not path.is_dir():
        return None
    for folder in (path, *sorted(path.glob("*_frames"))):
        for name in _TRACKS:
            if (folder / name).is_file():
                return folder / name
    for cameras, images in _POLYCAM:
        if (path / cameras).is_dir() and (path / images).is_dir():
            return path / cameras
    return path if next(path.glob("frame_*.json"), None) else None


def read_arkit(path: Path) -> Recording:
    """Read a recording of 3D Scanner App ("all data"), Polycam ("raw data") or ARKitScenes.

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
        return _read_arkitscenes(log, scene_id)
    if log == path:
        return _read_app(log, path, scene_id, _scanner_frame)
    images = next(path / images for cameras, images in _POLYCAM if path / cameras == log)
    return _read_app(log, images, scene_id, _polycam_frame)


def _read_app(log: Path, folder: Path, scene_id: str, read: _FrameReader) -> Recording:
    """Read one JSON file per image; an image without one is dropped, and the other way round."""
    images = {image.stem: image for image in images_in(folder)}
    logs = {entry.stem: entry for entry in log.glob("*.json")}
    if log == folder:
        logs = {stem: entry for stem, entry in logs.items() if stem.startswith("frame_")}
        images = {stem: image for stem, image in images.items() if stem.startswith("frame_")}
    both = sorted(images.keys() & logs.keys(), key=numbers_first)
    dropped = {stem: NO_POSE for stem in images.keys() - logs.keys()}
    dropped |= {stem: NO_IMAGE for stem in logs.keys() - images.keys()}
    size = stored_size([images[stem] for stem in both] or [log])
    return Recording(
        path=log,
        scene_id=scene_id,
        frames=tuple(read(read_json(logs[stem]), images[stem], size, str(logs[stem])) for stem in both),
        axes="opengl",
        up=(0.0, 1.0, 0.0),
        metric=True,
        dropped=dropped,
    )


def _scanner_frame(content: Mapping[str, Any], image: Path, size: tuple[int, int], where: str) -> Frame:
    pose = numbers(content, "cameraPoseARFrame", where, (4, 4))
    matrix = numbers(content, "intrinsics", where, (3, 3))
    lens = Lens(size, (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]))
    return Frame(frame_name(image.name), image, pose, check_lens(lens, where))


def _polycam_frame(content: Mapping[str, Any], image: Path, size: tuple[int, int], where: str) -> Frame:
    pose = np.eye(4)
    pose[:3] = [[number(content, f"t_{row}{column}", where) for column in range(4)] for row in range(3)]
    keys = ("fx", "fy", "cx", "cy", "width", "height")
    fx, fy, cx, cy, width, height = (number(content, key, where) for key in keys)
    lens = Lens((int(height), int(width)), (fx, fy), (cx, cy))
    return Frame(frame_name(image.name), image, pose, check_lens(lens, where))


def _read_arkitscenes(listed: Path, scene_id: str) -> Recording:
    """Read a track; each image gets the pose at its time and the nearest intrinsics."""
    table = read_table(listed)
    if table.ndim != 2 or table.shape[1] != 7:
        raise DataError(f"{listed} does not hold a time, a turn and a shift in each line: download it again")
    times, order = np.unique(table[:, 0], return_index=True)
    poses = np.tile(np.eye(4), (len(order), 1, 1))
    rotation = Rotation.from_rotvec(table[order, 1:4]).as_matrix().swapaxes(1, 2)
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = -(rotation @ table[order, 4:, None])[..., 0]
    folder, cameras = (listed.parent / name for name in _TRACKS[listed.name])
    for needed in (folder, cameras):
        if not needed.is_dir():
            raise DataError(f"{listed.parent} has no folder {needed.name}: download it again")
    pincams = sorted(cameras.glob("*.pincam"))
    if not pincams:
        raise DataError(f"{cameras} holds no .pincam files: download it again")
    pincam_times = np.array([_time(entry) for entry in pincams])
    images = images_in(folder)
    image_times = np.array([_time(image) for image in images])
    image_poses = poses_at(Track(listed, times, poses), image_times)
    frames, dropped = [], {}
    for image, time, pose in zip(images, image_times.tolist(), image_poses, strict=True):
        nearest = int(np.abs(pincam_times - time).argmin())
        if not np.isfinite(pose).all() or abs(pincam_times[nearest] - time) > _MAX_APART:
            dropped[frame_name(image.name)] = NO_POSE
        else:
            frames.append(Frame(frame_name(image.name), image, pose, _pincam(pincams[nearest])))
    return Recording(
        path=listed,
        scene_id=scene_id,
        frames=tuple(frames),
        up=(0.0, 0.0, 1.0),
        metric=True,
        dropped=dropped,
    )


def _pincam(path: Path) -> Lens:
    values = read_table(path)
    if values.size != 6:
        raise DataError(f"{path} does not hold `width height fx fy cx cy`: download it again")
    width, height, fx, fy, cx, cy = values.ravel().tolist()
    return check_lens(Lens((int(height), int(width)), (fx, fy), (cx, cy)), str(path))


def _time(path: Path) -> float:
    """Return the time in a name such as ``41254925_3211.498.png``, seconds."""
    try:
        return float(path.stem.rpartition("_")[2])
    except ValueError as error:
        raise DataError(f"{path} has no time in its name: download it again") from error
