# SPDX-License-Identifier: Apache-2.0
"""Pose tracks in text files, and folders of images that are matched to one by time.

The layout is that of TUM RGB-D and of most SLAM programs. ARKit's logs and videos use the same tracks.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from raytran.capture.lens import Lens, check_lens, opencv_lens
from raytran.capture.recording import Frame, Recording, frame_name, images_in, path_inside
from raytran.data.images import first_header
from raytran.data.scan import NO_POSE
from raytran.errors import DataError

TRACK_NAMES = (
    "trajectory.txt",
    "groundtruth.txt",
    "poses.txt",
    "CameraTrajectory.txt",
    "KeyFrameTrajectory.txt",
    "trajectory.tum",
)
INTRINSICS_NAMES = ("intrinsics.txt", "intrinsic.txt", "camera.txt", "calibration.txt")

_SAME_TIME = 0.005
"""Seconds between an image and a pose that are taken for simultaneous."""

_MAX_GAP = 0.25
"""Seconds between two poses over which a pose is interpolated."""

_MAX_BYTES = 64 * 2**20

_IMAGE_FOLDERS = ("rgb", "images", "color", "image", "frames", ".")
_IMAGE_LIST = "rgb.txt"
_TIME_IN_NAME = re.compile(r"(\d+(?:\.\d+)?)$")


@dataclass(frozen=True)
class Track:
    """Poses in the order of time.

    Attributes:
        path: file that holds them.
        times: ``(n,)`` seconds, rising; None: there is one pose per frame.
        world_from_camera: ``(n, 4, 4)`` float64; not finite where a pose was lost.
    """

    path: Path
    times: NDArray[np.float64] | None
    world_from_camera: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.world_from_camera)


def read_table(path: Path) -> NDArray[np.float64]:
    """Return the numbers in a text file, one row a line, split at blanks or commas; ``#`` starts comments.

    Raises:
        DataError: it cannot be read, or its lines are no rows of as many numbers each.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise DataError(f"{path} is larger than 64 MB, as no pose track is: check the path")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        rows = [line.partition("#")[0].replace(",", " ").split() for line in lines]
        return np.array([[float(word) for word in row] for row in rows if row], dtype=np.float64)
    except OSError as error:
        raise DataError(f"cannot read {path} ({error.strerror}): check the path") from error
    except ValueError as error:
        raise DataError(f"{path} does not hold as many numbers in each line ({error}): mend it") from error


def read_track(path: Path) -> Track:
    """Read a pose track: ``timestamp tx ty tz qx qy qz qw`` (TUM), or 12 or 16 numbers of a matrix per frame.

    Poses are camera-to-world, matrices row by row; timestamps in seconds, or in the micro- or nanoseconds
    since 1970 that some programs write.

    Raises:
        DataError: it is neither, or empty.
    """
    table = read_table(path)
    columns = table.shape[1] if table.ndim == 2 else 0
    if columns not in (8, 12, 16):
        raise DataError(
            f"{path} is no pose track: each line must hold `timestamp tx ty tz qx qy qz qw`, or the 12 or 16 "
            "numbers of a frame's camera-to-world matrix"
        )
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    if columns != 8:
        poses[:, :3] = table.reshape(len(table), -1, 4)[:, :3]
        return Track(path, None, poses)
    poses[:, :3, :3] = rotations(table[:, 4:])
    poses[:, :3, 3] = table[:, 1:4]
    times, first = np.unique(in_seconds(table[:, 0]), return_index=True)
    return Track(path, times, poses[first])


def rotations(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``(n, 3, 3)`` of quaternions ``[x, y, z, w]``; not finite where one is far from length one."""
    length = np.linalg.norm(quaternions, axis=1)
    is_unit = np.isfinite(length) & (np.abs(length - 1) < 0.1)
    matrices = np.full((len(quaternions), 3, 3), np.nan)
    if is_unit.any():
        matrices[is_unit] = Rotation.from_quat(quaternions[is_unit]).as_matrix()
    return matrices


def in_seconds(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return timestamps in seconds; micro- and nanoseconds since 1970 are recognised by their size."""
    largest = np.abs(times[np.isfinite(times)]).max(initial=0)
    return times / (1e9 if largest > 1e17 else 1e6 if largest > 1e14 else 1.0)


def poses_at(track: Track, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses at some times, ``(n, 4, 4)``; not finite where the track has none.

    Between two poses at most a quarter of a second apart the pose is interpolated, positions linearly and
    rotations along the shortest arc.

    Args:
        track: with times.
        times: ``(n,)`` seconds.
    """
    is_known = np.isfinite(track.world_from_camera).all(axis=(1, 2))
    known_poses = track.world_from_camera[is_known]
    all_times = np.arange(len(track), dtype=np.float64) if track.times is None else track.times
    known_times = all_times[is_known]
    poses = np.full((len(times), 4, 4), np.nan)
    if not len(known_times):
        return poses
    after = np.searchsorted(known_times, times).clip(max=len(known_times) - 1)
    before = (after - 1).clip(min=0)
    earlier, later = known_times[before], known_times[after]
    nearest = np.where(np.abs(earlier - times) < np.abs(later - times), before, after)
    is_same = np.abs(known_times[nearest] - times) <= _SAME_TIME
    poses[is_same] = known_poses[nearest[is_same]]
    is_between = ~is_same & (earlier < times) & (times < later) & (later - earlier <= _MAX_GAP)
    if is_between.any():
        at = times[is_between]
        rotation = Slerp(known_times, Rotation.from_matrix(known_poses[:, :3, :3]))(at)
        position = [np.interp(at, known_times, known_poses[:, axis, 3]) for axis in range(3)]
        poses[is_between] = np.eye(4)
        poses[is_between, :3, :3] = rotation.as_matrix()
        poses[is_between, :3, 3] = np.stack(position, axis=1)
    return poses


def read_camera(path: Path, *sizes: tuple[int, int]) -> Lens:
    """Read intrinsics: a 3×3 or 4×4 matrix, or ``fx fy cx cy [k1 k2 p1 p2 [k3]]``.

    Args:
        path: the file.
        sizes: ``(H, W)`` of the images that they are for; of several, as shown and as stored, the first in
            whose middle the principal point lies best.

    Raises:
        ConfigError: the lens distorts and pycolmap is not installed.
        DataError: the file holds neither, or they are no lens of such images; see ``check_lens``.
    """
    values = read_table(path)
    image_size = _nearest_size(values, sizes)
    if values.shape in ((3, 3), (4, 4)):
        focal, center = (values[0, 0], values[1, 1]), (values[0, 2], values[1, 2])
        return check_lens(Lens(image_size, focal, center), str(path))
    if values.size not in (4, 8, 9):
        raise DataError(
            f"{path} holds no intrinsics: write `fx fy cx cy` of the stored images, or with distortion "
            "`fx fy cx cy k1 k2 p1 p2`"
        )
    fx, fy, cx, cy, *distortion = values.ravel().tolist()
    k1, k2, p1, p2, k3 = (*distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    return opencv_lens(image_size, (fx, fy), (cx, cy), (k1, k2, k3, 0.0), (p1, p2), str(path))


def _nearest_size(values: NDArray[np.float64], sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Return the size in whose middle the principal point of intrinsics lies best."""
    is_matrix = values.shape in ((3, 3), (4, 4))
    center = values[:2, 2] if is_matrix else values.ravel()[2:4]
    if len(set(sizes)) == 1 or center.shape != (2,):
        return sizes[0]
    return min(sizes, key=lambda size: float(np.abs(center / np.array(size[::-1]) - 0.5).max()))


def find_track(folder: Path) -> Path | None:
    """Return the pose track in a folder, or None."""
    return next((folder / name for name in TRACK_NAMES if (folder / name).is_file()), None)


def find_images(folder: Path) -> list[Path]:
    """Return the images in ``folder``, or in the first of its folders that has some."""
    folders = (folder / name for name in _IMAGE_FOLDERS)
    return next((images for path in folders if path.is_dir() and (images := images_in(path))), [])


def find_intrinsics(folder: Path) -> Path:
    """Return the file of intrinsics in a folder.

    Raises:
        DataError: there is none.
    """
    path = next((folder / name for name in INTRINSICS_NAMES if (folder / name).is_file()), None)
    if path is None:
        raise DataError(
            f"{folder} has no {INTRINSICS_NAMES[0]}: write `fx fy cx cy` of the stored images there"
        )
    return path


def is_tum(path: Path) -> bool:
    """Whether a folder has a pose track and images."""
    return path.is_dir() and find_track(path) is not None and bool(find_images(path))


def read_tum(path: Path) -> Recording:
    """Read a folder with a pose track, images named or listed by their time, and ``intrinsics.txt``.

    Raises:
        DataError: a part is missing or damaged, images have no times, or no pose is near one in time.
    """
    listed = find_track(path) if path.is_dir() else None
    if listed is None:
        raise DataError(f"{path} has no pose track: wanted is one of {', '.join(TRACK_NAMES)}")
    track = read_track(listed)
    images = _timed_images(path, track)
    if not images:
        raise DataError(f"{path} has no images: put them in its folder rgb or images")
    header = first_header([image for image, _ in images])
    lens = read_camera(find_intrinsics(path), header.shown_size, header.size)
    poses = poses_at(track, np.array([time for _, time in images]))
    has_pose = [bool(np.isfinite(pose).all()) for pose in poses]
    if not any(has_pose):
        raise DataError(
            f"none of the {len(images)} images of {path} has a pose at its time among the {len(track)} "
            f"of {listed.name}: name the images by the track's timestamps, or write `timestamp file` "
            f"lines in {_IMAGE_LIST}"
        )
    names = [frame_name(image.name) for image, _ in images]
    return Recording(
        path=listed,
        scene_id=path.resolve().name,
        frames=tuple(
            Frame(name, image, pose, lens)
            for name, (image, _), pose, known in zip(names, images, poses, has_pose, strict=True)
            if known
        ),
        dropped={name: NO_POSE for name, known in zip(names, has_pose, strict=True) if not known},
        aligned=True,
        honours_exif=True,
    )


def _timed_images(folder: Path, track: Track) -> list[tuple[Path, float]]:
    """Return images and their times, seconds; where the poses have none, every image and its number."""
    if track.times is None:
        images = find_images(folder)
        if len(images) != len(track):
            raise DataError(
                f"{folder} has {len(images)} images and {len(track)} poses without times in "
                f"{track.path.name}: give one pose per image, or a timestamp with each "
                "(`timestamp tx ty tz qx qy qz qw`)"
            )
        return [(image, float(i)) for i, image in enumerate(images)]
    listed = folder / _IMAGE_LIST
    if listed.is_file():
        return _listed_images(folder, listed)
    images = find_images(folder)
    times = [_TIME_IN_NAME.search(image.stem) for image in images]
    if not all(times):
        without_time = next(image for image, time in zip(images, times, strict=True) if time is None)
        raise DataError(
            f"{without_time} has no time in its name: name images by the track's timestamps, or write "
            f"`timestamp file` lines in {listed}"
        )
    seconds = in_seconds(np.array([float(time[1]) for time in times if time]))
    return list(zip(images, seconds.tolist(), strict=True))


def _listed_images(folder: Path, listed: Path) -> list[tuple[Path, float]]:
    """Return images and times, seconds, of a file of `timestamp file` lines."""
    try:
        lines = listed.read_text(encoding="utf-8").splitlines()
        rows = [line.split(maxsplit=1) for line in lines if line.strip() and not line.startswith("#")]
        images = [path_inside(folder, name.strip(), listed) for _, name in rows]
        times = np.array([float(time) for time, _ in rows])
    except (OSError, ValueError) as error:
        raise DataError(f"{listed} does not hold `timestamp file` lines ({error}): mend it") from error
    return list(zip(images, in_seconds(times).tolist(), strict=True))
