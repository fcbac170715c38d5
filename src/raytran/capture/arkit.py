# SPDX-License-Identifier: Apache-2.0
"""Logs of Apple's ARKit: of the apps 3D Scanner App and Polycam, and of the data set ARKitScenes.

The apps write camera-to-world matrices row by row in OpenGL axes, +y up; ARKitScenes camera-from-world turns
and shifts in OpenCV axes, +z up. All are in metres. A phone held upright gives images that lie on their side.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from raytran.capture.imported import Shot, Source, frame_name, images_in
from raytran.capture.json_file import number, numbers, read_object
from raytran.capture.lens import Lens, check_lens
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
_Reader = Callable[[Mapping[str, Any], Path, tuple[int, int], str], Shot]
"""Makes a shot of a JSON file's content, its image, the size of the images, and the file's name."""

_MOST_APART = 0.02
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


def read_arkit(path: Path) -> Source:
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
        return _arkitscenes(log, scene_id)
    if log == path:
        return _app(log, path, scene_id, _scanner_shot)
    return _app(
        log,
        next(path / images for cameras, images in _POLYCAM if path / cameras == log),
        scene_id,
        _polycam_shot,
    )


def _app(log: Path, folder: Path, scene_id: str, read: _Reader) -> Source:
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
    shots = tuple(read(read_object(logs[stem]), images[stem], size, str(logs[stem])) for stem in both)
    return Source(
        path=log,
        scene_id=scene_id,
        shots=shots,
        axes="opengl",
        up=(0.0, 1.0, 0.0),
        metric=True,
        dropped=dropped,
    )


def _scanner_shot(content: Mapping[str, Any], image: Path, size: tuple[int, int], where: str) -> Shot:
    pose = numbers(content, "cameraPoseARFrame", where, (4, 4))
    matrix = numbers(content, "intrinsics", where, (3, 3))
    lens = Lens(size, (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]))
    return Shot(frame_name(image.name), image, pose, check_lens(lens, where))


def _polycam_shot(content: Mapping[str, Any], image: Path, size: tuple[int, int], where: str) -> Shot:
    pose = np.eye(4)
    pose[:3] = [[number(content, f"t_{row}{column}", where) for column in range(4)] for row in range(3)]
    fx, fy, cx, cy, width, height = (
        number(content, key, where) for key in ("fx", "fy", "cx", "cy", "width", "height")
    )
    lens = Lens((int(height), int(width)), (fx, fy), (cx, cy))
    return Shot(frame_name(image.name), image, pose, check_lens(lens, where))


def _arkitscenes(listed: Path, scene_id: str) -> Source:
    table = read_table(listed)
    if table.ndim != 2 or table.shape[1] != 7:
        raise DataError(f"{listed} does not hold a time, a turn and a shift in each line: download it again")
    moments, order = np.unique(table[:, 0], return_index=True)
    poses = np.tile(np.eye(4), (len(order), 1, 1))
    turn = Rotation.from_rotvec(table[order, 1:4]).as_matrix().swapaxes(1, 2)
    poses[:, :3, :3] = turn
    poses[:, :3, 3] = -(turn @ table[order, 4:, None])[..., 0]
    folder, cameras = (listed.parent / name for name in _TRACKS[listed.name])
    for part in (folder, cameras):
        if not part.is_dir():
            raise DataError(f"{listed.parent} has no folder {part.name}: download it again")
    images = images_in(folder)
    times = np.array([_time(image) for image in images])
    pincams = sorted(cameras.glob("*.pincam"))
    if not pincams:
        raise DataError(f"{cameras} holds no .pincam files: download it again")
    known = np.array([_time(entry) for entry in pincams])
    found = poses_at(Track(listed, moments, poses), times)
    shots, dropped = [], {}
    for image, time, pose in zip(images, times.tolist(), found, strict=True):
        near = int(np.abs(known - time).argmin())
        if not np.isfinite(pose).all() or abs(known[near] - time) > _MOST_APART:
            dropped[frame_name(image.name)] = NO_POSE
        else:
            shots.append(Shot(frame_name(image.name), image, pose, _pincam(pincams[near])))
    return Source(
        path=listed, scene_id=scene_id, shots=tuple(shots), up=(0.0, 0.0, 1.0), metric=True, dropped=dropped
    )


def _pincam(path: Path) -> Lens:
    values = read_table(path)
    if values.size != 6:
        raise DataError(f"{path} does not hold `width height fx fy cx cy`: download it again")
    width, height, fx, fy, cx, cy = values.ravel().tolist()
    return check_lens(Lens((int(height), int(width)), (fx, fy), (cx, cy)), str(path))


def _time(path: Path) -> float:
    """Return the time in a name such as ``41254925_3211.498.png``."""
    try:
        return float(path.stem.rpartition("_")[2])
    except ValueError as error:
        raise DataError(f"{path} has no time in its name: download it again") from error
