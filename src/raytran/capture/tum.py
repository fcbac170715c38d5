# SPDX-License-Identifier: Apache-2.0
"""A folder of images and a track of poses, matched by time: TUM RGB-D's layout and that of SLAM programs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from raytran.capture.imported import Shot, Source, frame_name, images_in, path_inside
from raytran.capture.trajectory import (
    INTRINSICS_NAMES,
    TRACK_NAMES,
    Track,
    are_known,
    in_seconds,
    poses_at,
    read_camera,
    read_track,
)
from raytran.data.images import stored_size
from raytran.data.scan import NO_POSE
from raytran.errors import DataError

_IMAGE_FOLDERS = ("rgb", "images", "color", "image", "frames", ".")
_LIST = "rgb.txt"
_TIME = re.compile(r"(\d+(?:\.\d+)?)$")


def find_track(folder: Path) -> Path | None:
    """Return the pose track in a folder, or None."""
    return next((folder / name for name in TRACK_NAMES if (folder / name).is_file()), None)


def find_images(folder: Path) -> list[Path]:
    """Return the images of the first folder in or of ``folder`` that has some."""
    places = (folder / name for name in _IMAGE_FOLDERS)
    return next((images for place in places if place.is_dir() and (images := images_in(place))), [])


def find_intrinsics(folder: Path) -> Path:
    """Return the file of intrinsics in a folder.

    Raises:
        DataError: there is none.
    """
    found = next((folder / name for name in INTRINSICS_NAMES if (folder / name).is_file()), None)
    if found is None:
        raise DataError(
            f"{folder} has no {INTRINSICS_NAMES[0]}: write `fx fy cx cy` of the stored images there"
        )
    return found


def is_tum(path: Path) -> bool:
    """Whether a folder has a pose track and images."""
    return path.is_dir() and find_track(path) is not None and bool(find_images(path))


def read_tum(path: Path) -> Source:
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
    lens = read_camera(find_intrinsics(path), stored_size([image for image, _ in images]))
    poses = poses_at(track, np.array([time for _, time in images]))
    posed = are_known(poses)
    if not any(posed):
        raise DataError(
            f"none of the {len(images)} images of {path} has a pose at its time among the {len(track)} "
            f"of {listed.name}: name the images by the track's timestamps, or write `timestamp file` "
            f"lines in {_LIST}"
        )
    names = [frame_name(image.name) for image, _ in images]
    return Source(
        path=listed,
        scene_id=path.resolve().name,
        shots=tuple(
            Shot(name, image, pose, lens)
            for name, (image, _), pose, good in zip(names, images, poses, posed, strict=True)
            if good
        ),
        dropped={name: NO_POSE for name, good in zip(names, posed, strict=True) if not good},
    )


def _timed_images(folder: Path, track: Track) -> list[tuple[Path, float]]:
    """Return images and their times; where poses have none, every image and its number."""
    if track.times is None:
        images = find_images(folder)
        if len(images) != len(track):
            raise DataError(
                f"{folder} has {len(images)} images and {len(track)} poses without times in "
                f"{track.path.name}: give one pose per image, or a timestamp with each "
                "(`timestamp tx ty tz qx qy qz qw`)"
            )
        return [(image, float(i)) for i, image in enumerate(images)]
    listed = folder / _LIST
    if listed.is_file():
        return _listed_images(folder, listed)
    images = find_images(folder)
    times = [_TIME.search(image.stem) for image in images]
    if not all(times):
        nameless = next(image for image, time in zip(images, times, strict=True) if time is None)
        raise DataError(
            f"{nameless} has no time in its name: name images by the track's timestamps, or write "
            f"`timestamp file` lines in {listed}"
        )
    seconds = in_seconds(np.array([float(time[1]) for time in times if time]))
    return list(zip(images, seconds.tolist(), strict=True))


def _listed_images(folder: Path, listed: Path) -> list[tuple[Path, float]]:
    try:
        lines = listed.read_text(encoding="utf-8").splitlines()
        rows = [line.split(maxsplit=1) for line in lines if line.strip() and not line.startswith("#")]
        found = [(path_inside(folder, name.strip(), listed), float(time)) for time, name in rows]
    except (OSError, ValueError) as error:
        raise DataError(f"{listed} does not hold `timestamp file` lines ({error}): mend it") from error
    seconds = in_seconds(np.array([time for _, time in found]))
    return [(image, time) for (image, _), time in zip(found, seconds.tolist(), strict=True)]
