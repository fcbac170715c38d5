# SPDX-License-Identifier: Apache-2.0
"""One scan, from any released form to the prepared folder and the masks of its frames."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from raytran.data.cache import MaskCache
from raytran.data.files import disk_full, finished_folder, write_json
from raytran.data.images import MIN_VIEWS
from raytran.data.prepare.annotation import Entry
from raytran.data.prepare.frames import homogeneous, matrix_text, write_frames
from raytran.data.prepare.settings import PrepareSettings
from raytran.data.scan2cad import parse_entry, scene_objects
from raytran.data.scannet.find import ScanSource
from raytran.data.scannet.scan import read_scan
from raytran.data.targets import foreground_masks
from raytran.errors import DataError
from raytran.geometry.camera import Cameras

FACTS = "prepared.json"
"""What became of a scan's frames; part of its prepared folder."""

_MASKS_AT_ONCE = 20


@dataclass(frozen=True)
class ScanJob:
    """A scan to prepare: where it lies, best form first, and its usable annotation if it has one."""

    scene_id: str
    sources: tuple[ScanSource, ...]
    entry: Entry | None = None


def scan_folder(output: Path, scene_id: str) -> Path:
    """Return where a prepared scan lies; it is finished if the folder exists."""
    return output / "scannet" / "scans" / scene_id


def prepare_scan(job: ScanJob, output: Path, settings: PrepareSettings) -> tuple[str, str | None]:
    """Prepare a scan unless it is there; if the best source fails the next is tried.

    Returns:
        the scan and, if none of its sources can be used, why.

    Raises:
        DataError: the disk of ``output`` is full or read-only.
    """
    final = scan_folder(output, job.scene_id)
    if final.is_dir():
        return job.scene_id, None
    reasons: list[str] = []
    for source in job.sources:
        try:
            with finished_folder(final) as folder:
                _write_scan(source, folder, settings, tried=reasons)
                if settings.masks and job.entry is not None:
                    # As a data set sees the cameras: through the files.
                    scan = read_scan(folder)
                    intrinsics = scan.intrinsics.expand(len(scan), 3, 3)
                    cameras = Cameras(intrinsics, scan.world_from_camera, settings.image_size)
                    write_masks(job.entry, cameras, output)
            return job.scene_id, None
        except (DataError, OSError) as error:
            check_room(error, output)
            reasons.append(str(error))
    return job.scene_id, "; ".join(reasons)


def write_masks(entry: Entry, cameras: Cameras, output: Path) -> None:
    """Make the amodal masks that a data set will ask for.

    Args:
        entry: annotation of the scan.
        cameras: of N frames.
        output: folder with ``shapenet/``; gets ``cache/``.

    Raises:
        DataError: a CAD model cannot be used, or the disk is full.
    """
    objects = scene_objects(parse_entry(entry))
    cache = MaskCache(folder=output / "cache")
    parts = zip(
        cameras.intrinsics.float().split(_MASKS_AT_ONCE),
        cameras.world_from_camera.float().split(_MASKS_AT_ONCE),
        strict=True,
    )
    for part in parts:
        foreground_masks(
            objects, Cameras(*part, cameras.image_size), shapenet_root=output / "shapenet", cache=cache
        )


def check_room(error: BaseException, output: Path) -> None:
    """Raise one sentence if ``error`` comes from a full or read-only disk.

    Raises:
        DataError: it does.
    """
    cause = disk_full(error)
    if cause is not None:
        raise DataError(
            f"cannot go on writing to {output} ({cause.strerror}): make room there and give the same command "
            "again, finished scans are kept"
        ) from error


def read_facts(output: Path, scene_id: str) -> dict[str, Any]:
    """Return what is known about a prepared scan's frames.

    Raises:
        DataError: the file is missing or damaged.
    """
    path = scan_folder(output, scene_id) / FACTS
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(
            f"cannot read {path} ({error}): remove the folder of that scan and give the same command again"
        ) from error


def _write_scan(source: ScanSource, folder: Path, settings: PrepareSettings, *, tried: list[str]) -> None:
    with source.open() as scan:
        used, damaged = write_frames(
            scan, folder, image_size=settings.image_size, max_frames=settings.max_frames
        )
        total = len(scan.frame_id) + len(scan.dropped)
        if len(used) < MIN_VIEWS:
            first = next(iter(damaged.values()), next(iter(scan.dropped.values()), "it has no more"))
            raise DataError(
                f"only {len(used)} of the {total} frames of {source.path} can be used ({first}): "
                "copy or export the scan again"
            )
        pose = scan.world_from_camera[used]
        cameras = Cameras(scan.intrinsics.expand(len(used), 3, 3), pose, scan.image_size)
        _write_camera_facts(folder, cameras.scaled_to(settings.image_size), scan.axis_alignment)
        write_json(
            folder / FACTS,
            {
                "form": source.form,
                "frames": total,
                "written": len(used),
                "dropped": scan.dropped,
                "cut": scan.damage,
                "damaged": damaged,
                "failed_sources": tried,
                "stored_size": list(scan.image_size),
                "camera_center": pose[:, :3, 3].mean(dim=0).tolist(),
                "bytes": sum(file.stat().st_size for file in (folder / "color").iterdir()),
            },
        )


def _write_camera_facts(folder: Path, cameras: Cameras, axis_alignment: torch.Tensor) -> None:
    """Write the intrinsics and ``<scan>.txt``, which say what the frames are now."""
    (folder / "intrinsic").mkdir()
    matrix = homogeneous(cameras.intrinsics[0])
    (folder / "intrinsic" / "intrinsic_color.txt").write_text(matrix_text(matrix), encoding="ascii")
    height, width = cameras.image_size
    facts: dict[str, object] = {
        "axisAlignment": " ".join(repr(value) for value in axis_alignment.flatten().tolist()),
        "colorHeight": height,
        "colorWidth": width,
        "fx_color": float(matrix[0, 0]),
        "fy_color": float(matrix[1, 1]),
        "mx_color": float(matrix[0, 2]),
        "my_color": float(matrix[1, 2]),
        "numColorFrames": len(cameras.intrinsics),
    }
    lines = "".join(f"{key} = {value}\n" for key, value in facts.items())
    (folder / f"{folder.name}.txt").write_text(lines, encoding="ascii")
