# SPDX-License-Identifier: Apache-2.0
"""Opening a scene in any format: the format is recognised, its reader called, the world brought to ours."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

from raytran.capture.arkit import find_log, read_arkit
from raytran.capture.colmap import find_model, read_colmap
from raytran.capture.exif import with_tags_of_files
from raytran.capture.nerfstudio import find_transforms, read_nerfstudio
from raytran.capture.orientation import WorldSettings, to_our_world
from raytran.capture.packed import UnpackedScan, is_packed, unpack
from raytran.capture.record3d import find_metadata, read_record3d
from raytran.capture.recording import Intrinsics, RecordedScan, Recording, open_recording
from raytran.capture.stray import find_odometry, open_stray, read_stray
from raytran.capture.trajectory import find_images, find_track, is_tum, read_tum
from raytran.capture.video import VIDEO_ENDINGS, find_video, open_video, read_video
from raytran.data.images import IMAGE_ENDINGS
from raytran.data.scan import OpenScan
from raytran.data.scannet.layout import Listing, recognise
from raytran.data.scannet.scan import open_scan
from raytran.errors import ConfigError, DataError, page
from raytran.limits import FOCAL_LENGTH, PIXEL, as_number, shown

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Format:
    """How to recognise a format, to read its poses, and to open its images."""

    fits: Callable[[Path], bool]
    read: Callable[[Path, Intrinsics | None], Recording]
    open: Callable[[Recording], RecordedScan] = open_recording


_FORMATS = {
    "nerfstudio": _Format(lambda path: find_transforms(path) is not None, read_nerfstudio),
    "record3d": _Format(lambda path: find_metadata(path) is not None, read_record3d),
    "arkit": _Format(lambda path: find_log(path) is not None, read_arkit),
    "stray": _Format(lambda path: find_odometry(path) is not None, read_stray, open_stray),
    "colmap": _Format(lambda path: find_model(path) is not None, read_colmap),
    "tum": _Format(is_tum, read_tum),
    "video": _Format(lambda path: find_video(path) is not None, read_video, open_video),
}
"""Formats beside ScanNet's, in the order of preference."""

FORMATS: tuple[str, ...] = ("auto", "scannet", *_FORMATS)

_READ = (
    "ScanNet, 7-Scenes, transforms.json, COLMAP, Polycam, 3D Scanner App, Record3D, Stray Scanner, "
    "ARKitScenes, trajectory.txt with rgb/, a video with poses"
)
"""What is read, in a few words."""

_MAX_LOOKED_AT, _MAX_NAMED = 200, 3
"""Folders that are tried, and named, where the scans lie deeper."""


def open_scene(
    path: Path,
    *,
    format: str = "auto",
    settings: WorldSettings | None = None,
    intrinsics: Intrinsics | None = None,
) -> OpenScan:
    """Open the frames of a scene in any format, in OpenCV axes, metres and with +z up.

    Use it in a ``with`` statement, or close it. What was recognised, and what is doubtful, is logged.

    Args:
        path: a folder, a file, or an archive of one.
        format: one of ``FORMATS``.
        settings: what is known of its world; None: everything is left to the format and the images.
        intrinsics: fx, fy, cx, cy of the stored images, pixels, in place of what files say or do not say.

    Raises:
        ConfigError: the format is unknown, or a package is missing: PyAV for videos, pycolmap for lenses that
            distort.
        DataError: the path does not exist, or fits no format, or is damaged; see the reader of its format.
    """
    if format not in FORMATS:
        raise ConfigError(f"unknown format={format}: choose one of {', '.join(FORMATS)}")
    settings = settings or WorldSettings()
    path = Path(path)
    if is_packed(path):
        return _open_packed(path, format, settings, intrinsics)
    name = _recognised(path) if format == "auto" else format
    if name == "scannet":
        scan: OpenScan = with_tags_of_files(open_scan(path, intrinsics))
        return to_our_world(scan, settings, up=(0.0, 0.0, 1.0) if _is_aligned(path) else None)
    recording = _FORMATS[name].read(path, intrinsics)
    scan = _FORMATS[name].open(recording)
    try:
        return to_our_world(
            scan,
            settings,
            axes=recording.axes,
            up=recording.up,
            metric=recording.metric,
            aligned=recording.aligned,
        )
    except BaseException:
        scan.close()
        raise


def parse_intrinsics(value: object) -> Intrinsics | None:
    """Return the intrinsics that a user typed: four numbers, as a list or as text; None if it is None.

    Raises:
        ConfigError: they are no intrinsics.
    """
    if value is None:
        return None
    words = value.strip("[]() ").replace(",", " ").split() if isinstance(value, str) else value
    try:
        fx, fy, cx, cy = (float(word) for word in words)  # type: ignore[attr-defined]
        focal = [as_number(number, FOCAL_LENGTH, "a focal length") for number in (fx, fy)]
        center = [as_number(number, PIXEL, "the principal point") for number in (cx, cy)]
    except (TypeError, ValueError, DataError) as error:
        raise ConfigError(
            f"intrinsics={shown(value)} are not fx,fy,cx,cy in pixels of the stored images: give four numbers"
        ) from error
    return focal[0], focal[1], center[0], center[1]


def _open_packed(
    path: Path, format: str, settings: WorldSettings, intrinsics: Intrinsics | None
) -> UnpackedScan:
    """Open the scene in an archive."""
    folder = unpack(path)
    try:
        root = next(Path(folder.name).iterdir())
        while format == "auto" and not _fitting(root) and len(inner := _folders_in(root)) == 1:
            root = inner[0]
        scan = open_scene(root, format=format, settings=settings, intrinsics=intrinsics)
    except DataError as error:
        folder.cleanup()
        raise DataError(str(error).replace(folder.name, str(path))) from error
    except BaseException:
        folder.cleanup()
        raise
    known = {field.name: getattr(scan, field.name) for field in fields(OpenScan)}
    return UnpackedScan(**known, archive=path, stored=scan, folder=folder)


def _recognised(path: Path) -> str:
    """Return the format of a scene.

    Raises:
        DataError: it fits none; the error says what it nearly is, and what it lacks.
    """
    if not os.path.exists(path):
        raise DataError(f"there is no scene {path}: check the path")
    fitting = _fitting(path)
    if len(fitting) > 1:
        _log.info("%s is there as %s: reading %s; format= chooses", path, ", ".join(fitting), fitting[0])
    if not fitting:
        raise _unknown(path)
    return fitting[0]


def _fitting(path: Path) -> list[str]:
    """Return the formats that a scene fits, the one to prefer first."""
    if path.is_file() and path.suffix == ".sens":
        return ["scannet"]
    fitting = [name for name, format in _FORMATS.items() if format.fits(path)]
    if path.is_dir() and _is_scannet(path):
        fitting.insert(0, "scannet")
    return fitting


def _is_scannet(folder: Path) -> bool:
    """Whether a folder has frames and poses in one of ScanNet's forms, or a recording."""
    listing = Listing.of(folder)
    layout = recognise(listing)
    if layout is None:
        return any(name.endswith(".sens") for name in listing.files)
    # A folder of colour images alone may belong to any format.
    return layout.form not in ("exporter", "odam") or (layout.base / "pose").is_dir()


def _is_aligned(path: Path) -> bool:
    """Whether a scene in one of ScanNet's forms promises a world whose +z is up; 7-Scenes' do not."""
    layout = recognise(Listing.of(path)) if path.is_dir() else None
    return layout is None or layout.is_aligned


def _unknown(path: Path) -> DataError:
    """Return the error for a scene in no format: what it nearly is and what it lacks, or what is read."""
    if path.suffix.lower() in IMAGE_ENDINGS:
        return DataError(f"{path} is one image: give the folder with all frames of the walk and their poses")
    if path.is_file():
        return DataError(
            f"{path} is in none of the formats {', '.join(FORMATS[1:])}: give a folder or a video"
        )
    listing = Listing.of(path)
    if not listing.files and not listing.folders:
        return DataError(f"{path} is empty: give the folder of a scene ({_READ})")
    lacking = _lacking(path, listing)
    if lacking is not None:
        return DataError(f"{path} {lacking}")
    scans = _scans_below(path)
    if scans:
        names = ", ".join(str(scan.relative_to(path)) for scan in scans[:_MAX_NAMED])
        more = f" and {len(scans) - _MAX_NAMED} more" if len(scans) > _MAX_NAMED else ""
        return DataError(f"{path} is no scene but holds some: give one of {names}{more}")
    if find_images(path):
        return DataError(
            f"{path} has images without poses: raytran poses finds them, or write "
            f"trajectory.txt and intrinsics.txt beside them ({page('own-data.md')})"
        )
    return DataError(f"{path} holds {listing.summary(most=2)}, and no scene: read are {_READ}")


def _lacking(path: Path, listing: Listing) -> str | None:
    """Return what a folder lacks for the format that it nearly has, and the remedy; None if it has none."""
    images = bool(find_images(path))
    track = find_track(path)
    videos = [name for name in listing.files if Path(name).suffix.lower() in VIDEO_ENDINGS]
    models = {"cameras", "images", "points3D"} & {Path(name).stem for name in listing.files}
    if len(videos) > 1:
        return f"holds {len(videos)} videos: give the path of one of them"
    if track is not None and not images:
        return f"has poses in {track.name} but no images: put them in its folder rgb or images"
    if {"metadata.json", "metadata"} & listing.files:
        return "has Record3D's metadata but no folder rgb/ or rgbd/ of images: export it as EXR + JPG"
    if "odometry.csv" in listing.files:
        return "has Stray Scanner's odometry.csv but no rgb.mp4 or rgb/: copy the whole recording"
    if "keyframes" in listing.folders:
        return "has Polycam's keyframes without cameras/ and images/ in it: export it as raw data"
    below = {file.stem for file in path.glob("sparse/**/*") if file.suffix in (".bin", ".txt")}
    models |= {"cameras", "images", "points3D"} & below
    if {"database.db"} & listing.files or (len(models) == 1 and models != {"images"}):
        return "has parts of a COLMAP project but no model: wanted are cameras and images, .bin or .txt"
    if {"color", "intrinsic"} <= listing.folders and "pose" not in listing.folders:
        return (
            "has ScanNet's color/ and intrinsic/ but no pose/: wanted is a 4x4 matrix in pose/0.txt for "
            "color/0.jpg"
        )
    return None


def _folders_in(folder: Path) -> list[Path]:
    return [folder / name for name in sorted(Listing.of(folder).folders)]


def _scans_below(path: Path) -> list[Path]:
    """Return the scenes up to three folders below a folder; none if one of these cannot be read."""
    found: list[Path] = []
    level, looked_at = [path], 0
    try:
        for _ in range(3):
            folders = [folder for parent in level for folder in _folders_in(parent)]
            folders = folders[: _MAX_LOOKED_AT - looked_at]
            looked_at += len(folders)
            fits = [bool(_fitting(folder)) for folder in folders]
            found += [folder for folder, is_scene in zip(folders, fits, strict=True) if is_scene]
            level = [folder for folder, is_scene in zip(folders, fits, strict=True) if not is_scene]
    except DataError:
        return []
    return found
