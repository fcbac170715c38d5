# SPDX-License-Identifier: Apache-2.0
"""Pose tracks in text files, and folders of images that are matched to one by time or by number.

The layout is that of TUM RGB-D and of most SLAM programs, and Replica's as they use it (``traj.txt`` with
``results/``). ARKit's logs and videos use the same tracks.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from raytran.capture.lens import Lens, check_lens, opencv_lens
from raytran.capture.names import frame_name, images_in, locate, unlike
from raytran.capture.recording import Frame, Intrinsics, Recording, nearest_size, number, typed_lens
from raytran.data.images import most_frequent_header
from raytran.data.scan import NO_POSE
from raytran.data.text import parted, read_json_object, read_table, read_text
from raytran.errors import DataError
from raytran.limits import FOCAL_LENGTH, PIXEL, SIDE

_log = logging.getLogger(__name__)

TRACK_NAMES = (
    "trajectory.txt",
    "groundtruth.txt",
    "poses.txt",
    "CameraTrajectory.txt",
    "KeyFrameTrajectory.txt",
    "trajectory.tum",
    "traj.txt",
)
INTRINSICS_NAMES = (
    "intrinsics.txt",
    "intrinsic.txt",
    "camera.txt",
    "calibration.txt",
    "camera-intrinsics.txt",
    "cam_params.json",
)
"""Files of intrinsics; the last is Replica's, which lies beside its scenes."""

_SAME_TIME = 0.005
"""Seconds between an image and a pose that are taken for simultaneous."""

_MAX_GAP = 0.25
"""Seconds between two poses over which a pose is interpolated."""

_IMAGE_FOLDERS = ("rgb", "images", "color", "image", "frames", "results", ".")
_IMAGE_LIST = "rgb.txt"
_TIME_IN_NAME = re.compile(r"(\d+(?:\.\d+)?)$")
_NUMBER_IN_NAME = re.compile(r"(\d+)\D*$")

NO_TIME = "no time in its name"
"""Reason why a frame is dropped."""

_FIRST_MOMENT = 1e8
"""Whole numbers in names from here on are seconds since 1970 (this is 1973); smaller ones count frames."""

_MAX_BAD_ROWS = 0.1
"""Share of the lines of a track, or of a list of images, that may be damaged."""


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


def read_track(path: Path) -> Track:
    """Read a pose track: ``timestamp tx ty tz qx qy qz qw`` (TUM), or 12 or 16 numbers of a matrix per frame.

    Poses are camera-to-world, matrices row by row; timestamps in seconds, or in the milli-, micro- or
    nanoseconds since 1970 that some programs write. A damaged line among ten is a lost pose.

    Raises:
        DataError: it is neither, or empty.
    """
    table = read_rows(path)
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
    is_timed = np.isfinite(table[:, 0])
    times, first = np.unique(in_seconds(table[is_timed, 0]), return_index=True)
    return Track(path, times, poses[is_timed][first])


def read_rows(path: Path) -> NDArray[np.float64]:
    """Return the numbers of a track, one row a pose; a damaged line among ten is a row of not-a-number.

    A line above the numbers that holds none is their heading.

    Raises:
        DataError: the file cannot be read or is damaged.
    """
    lines = [words for line in read_text(path).splitlines() if (words := parted(line))]
    if lines and not any(map(_as_floats, ([word] for word in lines[0]))):
        lines = lines[1:]
    rows = [_as_floats(words) for words in lines]
    widths = [len(row) for row in rows]
    width = max(set(widths), key=widths.count, default=0)
    num_bad = sum(other != width for other in widths)
    if not width or num_bad > _MAX_BAD_ROWS * len(rows):
        return read_table(path)  # which names the line
    if num_bad:
        _log.warning("%s: %d of %d lines hold no pose and are left out", path, num_bad, len(rows))
    lost = [np.nan] * width
    return np.array([row if len(row) == width else lost for row in rows], dtype=np.float64)


def _as_floats(words: Sequence[str]) -> list[float]:
    """Return words as numbers; none if one of them is no number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


def rotations(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``(n, 3, 3)`` of quaternions ``[x, y, z, w]``; not finite where one is far from length one."""
    # Larger numbers than any of a unit quaternion may overflow when they are squared.
    is_small = (np.abs(quaternions) < 2).all(axis=1, keepdims=True)
    length = np.linalg.norm(np.where(is_small, quaternions, 0.0), axis=1)
    is_unit = np.abs(length - 1) < 0.1
    matrices = np.full((len(quaternions), 3, 3), np.nan)
    if is_unit.any():
        matrices[is_unit] = Rotation.from_quat(quaternions[is_unit]).as_matrix()
    return matrices


def in_seconds(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return timestamps in seconds; those in milli-, micro- or nanoseconds since 1970 tell by their size."""
    largest = np.abs(times[np.isfinite(times)]).max(initial=0)
    unit = next((unit for unit in (1e9, 1e6, 1e3) if largest > _FIRST_MOMENT * unit), 1.0)
    return times / unit


def pair_in_order(
    images: Sequence[Path], num_poses: int, *, what: str, from_zero: bool = False
) -> tuple[list[int], list[int]]:
    """Return which images and which poses belong together where there is one pose per image and no time.

    If there are as many, the k-th pose belongs to the k-th image. If they differ, the numbers of the images
    must say which is missing: of images 0 to n without a gap, the last pose or image has no partner, since
    recordings are cut at their end; images 0 to n with gaps belong to the poses of their numbers, if there
    are n + 1.

    Args:
        images: in the order of their numbers.
        num_poses: number of poses.
        what: name of both in messages.
        from_zero: whether the format numbers its images from 0.

    Returns:
        positions of images and of poses, as many of each.

    Raises:
        DataError: it cannot be told what belongs together.
    """
    count = len(images)
    if count == num_poses:
        return list(range(count)), list(range(count))
    matches = [_NUMBER_IN_NAME.search(image.stem) for image in images]
    numbers = [int(match[1]) if match else -1 for match in matches]
    is_known = bool(numbers) and min(numbers) >= 0 and len(set(numbers)) == count
    if is_known and numbers == list(range(count)) and abs(count - num_poses) == 1:
        fewer = min(count, num_poses)
        more = "pose" if num_poses > count else "image"
        _log.warning("%s: the last %s has no partner and is left out", what, more)
        return list(range(fewer)), list(range(fewer))
    starts = numbers[:1] == [0] or from_zero
    if is_known and starts and num_poses in (max(numbers) + 1, max(numbers) + 2) and count < num_poses:
        _log.warning("%s: images are matched to poses by their numbers, of which some are missing", what)
        return list(range(count)), numbers
    raise DataError(
        f"{what}: {count} images and {num_poses} poses without times, so what belongs together is unknown: "
        "give one pose per image, or a timestamp with each (`timestamp tx ty tz qx qy qz qw`)"
    )


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
        path: the file; or Replica's ``cam_params.json``.
        sizes: ``(H, W)`` of the images that they are for; of several, as shown and as stored, the first in
            whose middle the principal point lies best.

    Raises:
        ConfigError: the lens distorts and pycolmap is not installed.
        DataError: the file holds neither, or they are no lens of such images; see ``check_lens``.
    """
    if path.suffix == ".json":
        return _replica_lens(path)
    values = read_table(path)
    if not (np.abs(values) <= FOCAL_LENGTH.high).all():  # not-a-number is not
        raise DataError(f"{path} holds numbers that are no pixels: write `fx fy cx cy` of the stored images")
    is_matrix = values.shape in ((3, 3), (4, 4))
    image_size = nearest_size(values[:2, 2] if is_matrix else values.ravel()[2:4], sizes)
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


def _replica_lens(path: Path) -> Lens:
    """Read Replica's intrinsics: an object ``camera`` with w, h, fx, fy, cx, cy."""
    content = read_json_object(path)
    camera = content.get("camera", content)
    values = camera if isinstance(camera, dict) else {}
    where = str(path)
    height, width = (int(number(values, key, SIDE, where)) for key in ("h", "w"))
    fx, fy = (number(values, key, FOCAL_LENGTH, where) for key in ("fx", "fy"))
    cx, cy = (number(values, key, PIXEL, where) for key in ("cx", "cy"))
    return check_lens(Lens((height, width), (fx, fy), (cx, cy)), where)


def find_track(folder: Path) -> Path | None:
    """Return the pose track in a folder, or None."""
    return next((folder / name for name in TRACK_NAMES if (folder / name).is_file()), None)


def find_images(folder: Path) -> list[Path]:
    """Return the colour images in ``folder``, or in the first of its folders that has some."""
    for path in (folder / name for name in _IMAGE_FOLDERS):
        if path.is_dir() and (images := images_in(path)):
            # Replica's results/ has depth000000.png beside frame000000.jpg.
            colour = [image for image in images if not image.name.lower().startswith("depth")]
            return colour or images
    return []


def find_intrinsics(folder: Path) -> Path | None:
    """Return the file of intrinsics in a folder, or else in the one above it; None if there is none."""
    above = folder.resolve().parent
    places = [*(folder / name for name in INTRINSICS_NAMES), *(above / name for name in INTRINSICS_NAMES)]
    path = next((place for place in places if place.is_file()), None)
    if path is not None and path.parent == above:
        _log.info("%s: the intrinsics are those of %s", folder, path)
    return path


def shared_lens(folder: Path, *sizes: tuple[int, int], intrinsics: Intrinsics | None) -> Lens:
    """Return the lens of all images of a folder: what the user typed, or else what a file says.

    Args:
        folder: of the pose track.
        sizes: ``(H, W)`` of the images; see ``read_camera``.
        intrinsics: fx, fy, cx, cy that the user typed.

    Raises:
        ConfigError, DataError: see ``read_camera``; or there is no file.
    """
    if intrinsics is not None:
        return typed_lens(intrinsics, *sizes)
    path = find_intrinsics(folder)
    if path is None:
        raise DataError(
            f"{folder} has no {INTRINSICS_NAMES[0]}: write `fx fy cx cy` of the stored images there, or give "
            "intrinsics=fx,fy,cx,cy"
        )
    return read_camera(path, *sizes)


def is_tum(path: Path) -> bool:
    """Whether a folder has a pose track and images."""
    return path.is_dir() and find_track(path) is not None and bool(find_images(path))


def read_tum(path: Path, intrinsics: Intrinsics | None = None) -> Recording:
    """Read a folder with a pose track, images named or listed by their time, and ``intrinsics.txt``.

    Args:
        path: the folder.
        intrinsics: of the stored images, in place of those in a file.

    Raises:
        DataError: a part is missing or damaged, images have no times, or no pose is near one in time.
    """
    listed = find_track(path) if path.is_dir() else None
    if listed is None:
        raise DataError(f"{path} has no pose track: wanted is one of {', '.join(TRACK_NAMES)}")
    track = read_track(listed)
    posed, dropped = _posed_images(path, track)
    if not posed:
        raise DataError(f"{path} has no images: put them in its folder rgb or images")
    images = [image for image, _ in posed]
    header = most_frequent_header([image for image in images if os.path.isfile(image)] or images)
    lens = shared_lens(path, header.shown_size, header.size, intrinsics=intrinsics)
    has_pose = [bool(np.isfinite(pose).all()) for _, pose in posed]
    if not any(has_pose):
        raise DataError(
            f"none of the {len(images)} images of {path} has a pose at its time among the {len(track)} "
            f"of {listed.name}: name the images by the track's timestamps, or write `timestamp file` "
            f"lines in {_IMAGE_LIST}"
        )
    names = unlike([frame_name(image.name) for image in images], dropped)
    frames = tuple(
        Frame(name, image, pose, lens)
        for name, (image, pose), known in zip(names, posed, has_pose, strict=True)
        if known
    )
    dropped |= {name: NO_POSE for name, known in zip(names, has_pose, strict=True) if not known}
    return Recording(
        path=listed,
        scene_id=path.resolve().name,
        frames=frames,
        dropped=dropped,
        aligned=True,
        honours_exif=True,
    )


_Posed = list[tuple[Path, NDArray[np.float64]]]
"""Images and their poses ``(4, 4)``, which are not finite where there is none."""


def _posed_images(folder: Path, track: Track) -> tuple[_Posed, dict[str, str]]:
    """Return the images of a folder and their poses, and the reason for each that is not there.

    Raises:
        DataError: what belongs together cannot be told.
    """
    listed = folder / _IMAGE_LIST
    if track.times is not None and listed.is_file():
        listed_images, times, dropped = _listed_images(folder, listed)
        return list(zip(listed_images, poses_at(track, times), strict=True)), dropped
    images = find_images(folder)
    if not images:
        return [], {}
    if track.times is None:
        return _in_order(images, track.world_from_camera, f"{folder} ({track.path.name})"), {}
    found = [(image, _TIME_IN_NAME.search(image.stem)) for image in images]
    timed = [(image, match[1]) for image, match in found if match]
    if not timed:
        raise DataError(
            f"{images[0]} has no time in its name: name images by the track's timestamps, or write "
            f"`timestamp file` lines in {listed}"
        )
    # Files of other names lie among the frames by chance, as a cover picture does.
    dropped = dict.fromkeys(unlike([frame_name(image.name) for image, match in found if not match]), NO_TIME)
    images = [image for image, _ in timed]
    words = [word for _, word in timed]
    numbers = np.array([float(word) for word in words])
    counts_frames = not any("." in word for word in words) and (numbers < _FIRST_MOMENT).all()
    if counts_frames and not _are_moments(numbers, track.times):
        return _numbered(images, numbers, track), dropped
    return list(zip(images, poses_at(track, in_seconds(numbers)), strict=True)), dropped


def _in_order(images: list[Path], poses: NDArray[np.float64], what: str) -> _Posed:
    """Return images and their poses where these have no times; where there is none it is lost."""
    of_image, of_pose = pair_in_order(images, len(poses), what=what)
    lost = np.full((4, 4), np.nan)
    partner = dict(zip(of_image, of_pose, strict=True))
    return [(image, poses[partner[i]] if i in partner else lost) for i, image in enumerate(images)]


def _are_moments(numbers: NDArray[np.float64], times: NDArray[np.float64]) -> bool:
    """Whether whole numbers in the names of images mean the same as the whole numbers in a track.

    They do if every image has a pose of its number; or if every pose has an image and the poses are those of
    key frames, of uneven numbers. Even whole numbers with more images than poses may be seconds.
    """
    is_whole = bool((times == np.round(times)).all())
    is_uneven = len(set(np.diff(times).tolist())) > 1
    return is_whole and bool(
        np.isin(numbers, times).all() or (is_uneven and len(times) > 2 and np.isin(times, numbers).all())
    )


def _numbered(images: list[Path], numbers: NDArray[np.float64], track: Track) -> _Posed:
    """Return images that are numbered, and the poses of a track of seconds, if there are as many.

    Raises:
        DataError: there are not: a number is no time, and which frame was at which time is not known.
    """
    is_consecutive = bool((np.diff(np.sort(numbers)) == 1).all())
    if is_consecutive and len(images) == len(track):
        _log.warning(
            "%s: its images are numbered, not named by times: the n-th image gets the n-th of as many poses",
            track.path,
        )
        order = np.argsort(numbers)
        poses = track.world_from_camera[np.argsort(order)]
        return list(zip(images, poses, strict=True))
    raise DataError(
        f"the {len(images)} images of {images[0].parent} are numbered, and which has which of the "
        f"{len(track)} times in {track.path.name} is unknown: name them by times in seconds (1.50.jpg), or "
        f"write `timestamp file` lines in {_IMAGE_LIST}"
    )


def _listed_images(folder: Path, listed: Path) -> tuple[list[Path], NDArray[np.float64], dict[str, str]]:
    """Read `timestamp file` lines: images, their times in seconds, the reason for each image without place.

    Raises:
        DataError: it does not hold such lines, or all images are elsewhere.
    """
    lines = [line for line in read_text(listed).splitlines() if line.strip() and not line.startswith("#")]
    if lines and not _as_floats(lines[0].split()[:1]):
        lines = lines[1:]  # a heading
    words = [row for line in lines if len(row := line.split(maxsplit=1)) == 2]
    rows = [(time, name.strip()) for time, name in words if _as_floats([time])]
    if len(lines) - len(rows) > _MAX_BAD_ROWS * len(lines):
        raise DataError(f"{listed} does not hold `timestamp file` lines: mend it")
    if len(rows) < len(lines):
        _log.warning(
            "%s: %d of %d lines are damaged and left out", listed, len(lines) - len(rows), len(lines)
        )
    times = np.array([float(time) for time, _ in rows])
    names = [name for _, name in rows]
    located = locate(names, folder)
    located.report(listed, folder)
    places = [(i, place) for i, place in enumerate(located.places) if isinstance(place, Path)]
    frames = unlike([frame_name(name) for name in names])
    dropped = {
        name: place for name, place in zip(frames, located.places, strict=True) if isinstance(place, str)
    }
    return [place for _, place in places], in_seconds(times)[[i for i, _ in places]], dropped
