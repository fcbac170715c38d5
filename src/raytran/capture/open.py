# SPDX-License-Identifier: Apache-2.0
"""Opening a scene in any format: the format is recognised, its reader called, the world brought to ours."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from raytran.capture.arkit import find_log, read_arkit
from raytran.capture.colmap import find_model, read_colmap
from raytran.capture.exif import with_tags_of_files
from raytran.capture.nerfstudio import find_transforms, read_nerfstudio
from raytran.capture.orientation import WorldSettings, to_our_world
from raytran.capture.record3d import find_metadata, read_record3d
from raytran.capture.recording import RecordedScan, Recording, open_recording
from raytran.capture.trajectory import is_tum, read_tum
from raytran.capture.video import find_video, open_video, read_video
from raytran.data.scan import OpenScan
from raytran.data.scannet.layout import Listing, recognise
from raytran.data.scannet.scan import open_scan
from raytran.errors import ConfigError, DataError

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Format:
    """How to recognise a format, to read its poses, and to open its images."""

    fits: Callable[[Path], bool]
    read: Callable[[Path], Recording]
    open: Callable[[Recording], RecordedScan] = open_recording


_FORMATS = {
    "nerfstudio": _Format(lambda path: find_transforms(path) is not None, read_nerfstudio),
    "record3d": _Format(lambda path: find_metadata(path) is not None, read_record3d),
    "arkit": _Format(lambda path: find_log(path) is not None, read_arkit),
    "colmap": _Format(lambda path: find_model(path) is not None, read_colmap),
    "tum": _Format(is_tum, read_tum),
    "video": _Format(lambda path: find_video(path) is not None, read_video, open_video),
}
"""Formats beside ScanNet's, in the order of preference."""

FORMATS: tuple[str, ...] = ("auto", "scannet", *_FORMATS)


def open_scene(path: Path, *, format: str = "auto", settings: WorldSettings | None = None) -> OpenScan:
    """Open the frames of a scene in any format, in OpenCV axes, metres and with +z up.

    Use it in a ``with`` statement, or close it. What was recognised, and what is doubtful, is logged.

    Args:
        path: a folder or file.
        format: one of ``FORMATS``.
        settings: what is known of its world; None: everything is left to the format and the images.

    Raises:
        ConfigError: the format is unknown, or a package is missing: PyAV for videos, pycolmap for lenses that
            distort.
        DataError: the path does not exist, or fits no format, or is damaged; see the reader of its format.
    """
    if format not in FORMATS:
        raise ConfigError(f"unknown format={format}: choose one of {', '.join(FORMATS)}")
    settings = settings or WorldSettings()
    path = Path(path)
    name = _recognised(path) if format == "auto" else format
    if name == "scannet":
        scan: OpenScan = with_tags_of_files(open_scan(path))
        return to_our_world(scan, settings, up=(0.0, 0.0, 1.0))
    recording = _FORMATS[name].read(path)
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


def _recognised(path: Path) -> str:
    """Return the format of a scene; ScanNet's for what fits none, so that its reader says what is wrong."""
    if not path.exists():
        raise DataError(f"there is no scene {path}: check the path")
    if path.is_file() and path.suffix == ".sens":
        return "scannet"
    fitting = [name for name, format in _FORMATS.items() if format.fits(path)]
    if path.is_dir() and _is_scannet(path):
        fitting.insert(0, "scannet")
    if len(fitting) > 1:
        _log.info("%s is there as %s: reading %s; format= chooses", path, ", ".join(fitting), fitting[0])
    if fitting:
        return fitting[0]
    if path.is_file():
        raise DataError(
            f"{path} is in none of the formats {', '.join(FORMATS[1:])}: give a folder or a video"
        )
    return "scannet"


def _is_scannet(folder: Path) -> bool:
    """Whether a folder has frames and poses in one of ScanNet's forms, or a recording."""
    listing = Listing.of(folder)
    layout = recognise(listing)
    if layout is None:
        return any(name.endswith(".sens") for name in listing.files)
    # A folder of colour images alone may belong to any format.
    return layout.form not in ("exporter", "odam") or (layout.base / "pose").is_dir()
