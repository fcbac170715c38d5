# SPDX-License-Identifier: Apache-2.0
"""Recordings of the app Stray Scanner: ``odometry.csv``, ``camera_matrix.csv``, and ``rgb.mp4`` or ``rgb/``.

Each row has the number of a frame and its position and quaternion ``x y z qx qy qz qw``, camera-to-world in
OpenCV axes, metres and the +y up world of ARKit (StrayVisualizer, ``read_data``).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from raytran.capture.lens import Lens, check_lens
from raytran.capture.names import frame_name, images_in, unlike
from raytran.capture.recording import (
    NO_LENS,
    Frame,
    FrameList,
    Intrinsics,
    RecordedScan,
    Recording,
    open_recording,
    typed_lens,
)
from raytran.capture.trajectory import read_rows, rotations
from raytran.capture.video import VideoFile, open_video
from raytran.data.images import stored_size
from raytran.data.scan import NO_IMAGE, NO_POSE
from raytran.data.text import parted, read_table, read_text
from raytran.errors import DataError
from raytran.limits import PIXEL, as_number

_ODOMETRY = "odometry.csv"
_CAMERA = "camera_matrix.csv"
_VIDEO = "rgb.mp4"
_IMAGES = "rgb"

_VIDEO_SIZE = (1440, 1920)
"""``(H, W)`` of the app's videos, for which its camera matrix is; extracted images may be smaller."""

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_LENS = ("fx", "fy", "cx", "cy")
_NUMBER = re.compile(r"(\d+)$")


def find_odometry(path: Path) -> Path | None:
    """Return the poses of the recording that a folder, or the video in it, is; None if it is none."""
    folder = path.parent if path.name == _VIDEO else path
    has_images = (folder / _VIDEO).is_file() or (folder / _IMAGES).is_dir()
    return folder / _ODOMETRY if has_images and (folder / _ODOMETRY).is_file() else None


def read_stray(path: Path, intrinsics: Intrinsics | None = None) -> Recording:
    """Read a recording of Stray Scanner; its images are the frames of ``rgb.mp4``, or those in ``rgb/``.

    Args:
        path: its folder, or the video in it.
        intrinsics: of the stored images, in place of ``camera_matrix.csv``.

    Raises:
        ConfigError: there is a video and PyAV is not installed.
        DataError: a part is missing or damaged.
    """
    listed = find_odometry(path)
    if listed is None:
        raise DataError(
            f"{path} holds no {_ODOMETRY} beside {_VIDEO} or {_IMAGES}/: copy the whole recording"
        )
    folder = listed.parent
    images = images_in(folder / _IMAGES) if (folder / _IMAGES).is_dir() else []
    video = None if images else folder / _VIDEO
    if video is None:
        numbered = {int(m[1]): image for image in images if (m := _NUMBER.search(image.stem))}
        size = stored_size(images)
        of_name = dict(zip(unlike([frame_name(image.name) for image in images]), images, strict=True))
        name_of = {image: name for name, image in of_name.items()}
        places = {number: (name_of[image], image) for number, image in numbered.items()}
    else:
        file = VideoFile(video)
        file.close()
        size = file.image_size
        places = {number: (str(number), video) for number in range(len(file.times))}
    columns = _columns(listed)
    numbers = columns["frame"].astype(np.int64)
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, :3] = rotations(np.stack([columns[key] for key in _POSE[3:]], axis=1))
    poses[:, :3, 3] = np.stack([columns[key] for key in _POSE[:3]], axis=1)
    shared = typed_lens(intrinsics, size) if intrinsics is not None else None
    if shared is None and not columns.keys() >= set(_LENS):
        shared = _camera(folder / _CAMERA, size)
    known = set(numbers.tolist())
    collected = FrameList({name: NO_POSE for n, (name, _) in places.items() if n not in known})
    for i, n in enumerate(numbers.tolist()):
        if n not in places:
            collected.dropped[str(n)] = NO_IMAGE
            continue
        name, image = places[n]
        with collected.sparing(name, NO_LENS):
            lens = shared or _lens([float(columns[key][i]) for key in _LENS], size, str(listed))
            collected.frames.append(Frame(name, image, poses[i], lens, n if video else 0))
    return Recording(
        path=video or listed,
        scene_id=folder.resolve().name,
        frames=collected.checked(),
        up=(0.0, 1.0, 0.0),
        metric=True,
        dropped=collected.dropped,
    )


def open_stray(recording: Recording) -> RecordedScan:
    """Return the scan of a recording whose images are files, or the frames of a video.

    Raises:
        DataError: see ``build_scan`` and ``VideoFile``.
    """
    return open_video(recording) if recording.path.name == _VIDEO else open_recording(recording)


def _columns(listed: Path) -> dict[str, NDArray[np.float64]]:
    """Return the columns of the table by their names; a row whose numbers are damaged is not-a-number.

    Raises:
        DataError: it has no columns of positions and quaternions.
    """
    table = read_rows(listed)
    heading = [word.strip().lower() for word in parted((read_text(listed).splitlines() or [""])[0])]
    columns = table.shape[1] if table.ndim == 2 else 0
    if len(heading) != columns or not set(_POSE) <= set(heading):
        heading = [*([] if columns == len(_POSE) else ["timestamp", "frame"]), *_POSE]
    if columns != len(heading):
        raise DataError(
            f"{listed} has {columns} columns, not timestamp, frame, x, y, z, qx, qy, qz, qw: copy it again"
        )
    found = {name: table[:, i] for i, name in enumerate(heading)}
    numbers = found.get("frame", np.arange(len(table), dtype=np.float64))
    is_number = np.isfinite(numbers) & (numbers >= 0) & (numbers < 1e9)
    return {name: values[is_number] for name, values in (found | {"frame": numbers}).items()}


def _camera(path: Path, size: tuple[int, int]) -> Lens:
    """Return the lens in ``camera_matrix.csv``, for images of ``size`` or of the app's videos."""
    if not path.is_file():
        raise DataError(f"{path} is missing: copy the whole recording, or give intrinsics=fx,fy,cx,cy")
    values = read_table(path)
    if values.shape != (3, 3):
        raise DataError(f"{path} does not hold a 3x3 camera matrix: copy it again")
    fx, fy, cx, cy = values[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return _lens([fx, fy, cx, cy], size, str(path))


def _lens(values: list[float], size: tuple[int, int], where: str) -> Lens:
    """Return the lens of a row, for images of ``size`` or of the app's videos."""
    fx, fy, cx, cy = (as_number(value, PIXEL, f"the camera in {where}") for value in values)

    def off(size: tuple[int, int]) -> float:
        return max(abs(cx / size[1] - 0.5), abs(cy / size[0] - 0.5))

    # The principal point is near the middle of the images that it is for.
    fitting = min((size, _VIDEO_SIZE), key=off)
    return check_lens(Lens(fitting, (fx, fy), (cx, cy)), where)
