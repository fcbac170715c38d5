# SPDX-License-Identifier: Apache-2.0
"""Pose tracks and intrinsics in text files, and the pose at the time of an image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from raytran.capture.lens import Lens, check_lens, opencv_lens
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

_LONGEST_GAP = 0.25
"""Seconds between two poses over which a pose is interpolated."""

_MAX_BYTES = 64 * 2**20


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
    """Return ``(n, 3, 3)`` of quaternions ``[x, y, z, w]``; not finite where one is none."""
    length = np.linalg.norm(quaternions, axis=1)
    good = np.isfinite(length) & (np.abs(length - 1) < 0.1)
    matrices = np.full((len(quaternions), 3, 3), np.nan)
    if good.any():
        matrices[good] = Rotation.from_quat(quaternions[good]).as_matrix()
    return matrices


def in_seconds(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return timestamps in seconds; those of today in micro- or nanoseconds are told by their size."""
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
    known = np.isfinite(track.world_from_camera).all(axis=(1, 2))
    poses = track.world_from_camera[known]
    at = (np.arange(len(track), dtype=np.float64) if track.times is None else track.times)[known]
    found = np.full((len(times), 4, 4), np.nan)
    if not len(at):
        return found
    after = np.searchsorted(at, times).clip(max=len(at) - 1)
    before = (after - 1).clip(min=0)
    nearest = np.where(np.abs(at[before] - times) < np.abs(at[after] - times), before, after)
    same = np.abs(at[nearest] - times) <= _SAME_TIME
    found[same] = poses[nearest[same]]
    between = ~same & (at[before] < times) & (times < at[after]) & (at[after] - at[before] <= _LONGEST_GAP)
    if between.any():
        when = times[between]
        found[between] = np.eye(4)
        found[between, :3, :3] = Slerp(at, Rotation.from_matrix(poses[:, :3, :3]))(when).as_matrix()
        found[between, :3, 3] = np.stack([np.interp(when, at, poses[:, i, 3]) for i in range(3)], axis=1)
    return found


def are_known(poses: NDArray[np.float64]) -> list[bool]:
    """Return for each of ``(n, 4, 4)`` poses whether it is finite."""
    return [bool(np.isfinite(pose).all()) for pose in poses]


def read_camera(path: Path, image_size: tuple[int, int]) -> Lens:
    """Read intrinsics: a 3×3 or 4×4 matrix, or ``fx fy cx cy [k1 k2 p1 p2 [k3]]``.

    Args:
        path: the file.
        image_size: ``(H, W)`` of the images that they are for.

    Raises:
        DataError: the file holds neither, or they are no lens of such images; see ``check_lens``.
    """
    values = read_table(path)
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
