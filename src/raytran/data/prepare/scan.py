# SPDX-License-Identifier: Apache-2.0
"""One scan, from any released form to the prepared folder: few small frames, their cameras and masks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from raytran.data.files import finished_folder, write_json
from raytran.data.images import MIN_VIEWS
from raytran.data.prepare.annotation import Entry
from raytran.data.prepare.targets import check_disk, write_masks
from raytran.data.scan import OpenScan
from raytran.data.scannet.find import ScanSource
from raytran.data.scannet.layout import FRAME_CAMERAS
from raytran.data.scannet.scan import read_scan
from raytran.data.text import read_json_object
from raytran.data.views import choose_even
from raytran.errors import ConfigError, DataError
from raytran.geometry.camera import Cameras

FACTS = "prepared.json"
"""File in a prepared scan's folder that says what became of its frames."""

JPEG_QUALITY = 90
"""Of resized frames; a frame that has the right size already keeps its bytes."""

_PNG = b"\x89PNG"


@dataclass(frozen=True)
class PrepareSettings:
    """The settings on which the bytes of a prepared scan depend.

    Attributes:
        image_size: ``(H, W)`` of the frames.
        max_frames: at most so many frames a scan, evenly spread; None for all.
        masks: whether the amodal masks of all frames are made ahead of training.
    """

    image_size: tuple[int, int] = (480, 640)
    max_frames: int | None = 200
    masks: bool = True

    def __post_init__(self) -> None:
        if min(self.image_size) < 16 or (self.max_frames is not None and self.max_frames < 2):
            raise ConfigError(
                "expected images of at least 16 × 16 pixels and max_frames ≥ 2, got "
                f"image_size={list(self.image_size)} and max_frames={self.max_frames}"
            )


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
    """Prepare a scan unless it is prepared already; if the best source fails the next is tried.

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
                    write_masks(job.entry, read_scan(folder).cameras, output)
            return job.scene_id, None
        except (DataError, OSError) as error:
            check_disk(error, output)
            reasons.append(str(error))
    return job.scene_id, "; ".join(reasons)


def read_facts(output: Path, scene_id: str) -> dict[str, Any]:
    """Return the facts of a prepared scan's frames, see ``FACTS``.

    Raises:
        DataError: the file is missing or damaged.
    """
    path = scan_folder(output, scene_id) / FACTS
    try:
        return read_json_object(path)
    except DataError as error:
        raise DataError(
            f"{error}; or remove the folder of that scan and give the same command again"
        ) from error


def _write_scan(source: ScanSource, folder: Path, settings: PrepareSettings, *, tried: list[str]) -> None:
    with source.open() as scan:
        write_scan(scan, folder, settings, form=source.form, facts={"failed_sources": tried})


def write_scan(
    scan: OpenScan, folder: Path, settings: PrepareSettings, *, form: str, facts: Mapping[str, object]
) -> None:
    """Write an open scan's frames, cameras and facts into an empty folder.

    Args:
        scan: of any source.
        folder: of the prepared scan.
        settings: of the preparation.
        form: what the scan was recognised as.
        facts: more to say in ``FACTS``.

    Raises:
        DataError: fewer than two frames can be used.
    """
    used, damaged = write_frames(scan, folder, image_size=settings.image_size, max_frames=settings.max_frames)
    total = len(scan.frame_id) + len(scan.dropped)
    if len(used) < MIN_VIEWS:
        first = next(iter(damaged.values()), next(iter(scan.dropped.values()), "it has no more"))
        raise DataError(
            f"only {len(used)} of the {total} frames of {scan.path} can be used ({first}): "
            "copy or export the scan again"
        )
    pose = scan.world_from_camera[used]
    cameras = scan.cameras[used].scaled_to(settings.image_size)
    _write_camera_facts(folder, cameras, scan.axis_alignment)
    names = frame_names(scan.frame_id)
    _write_frame_cameras(folder, cameras, [names[position] for position in used])
    write_json(
        folder / FACTS,
        {
            "form": form,
            "frames": total,
            "written": len(used),
            "dropped": scan.dropped,
            "cut": scan.damage,
            "damaged": damaged,
            **facts,
            "stored_size": list(scan.image_size),
            "camera_center": pose[:, :3, 3].mean(dim=0).tolist(),
            "bytes": sum(file.stat().st_size for file in (folder / "color").iterdir()),
        },
    )


def _write_frame_cameras(folder: Path, cameras: Cameras, names: Sequence[str]) -> None:
    """Write the camera of each frame, see ``read_frame_cameras``, unless one does for all."""
    columns = torch.stack([cameras.intrinsics[:, i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))], dim=1)
    if cameras.picture is not None:
        columns = torch.cat([columns, cameras.picture], dim=1)
    elif bool((columns == columns[0]).all()):
        return
    rows = zip(names, columns.double().tolist(), strict=True)
    text = "".join(f"{name}\t{' '.join(map(repr, values))}\n" for name, values in rows)
    (folder / FRAME_CAMERAS).write_text(text, encoding="utf-8")


def _write_camera_facts(folder: Path, cameras: Cameras, axis_alignment: torch.Tensor) -> None:
    """Write the intrinsics and ``<scan>.txt``, which say what the frames are now."""
    (folder / "intrinsic").mkdir()
    matrix = homogeneous(_middle_intrinsics(cameras))
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


def _middle_intrinsics(cameras: Cameras) -> Tensor:
    """Return intrinsics that can stand for all: those of the image that is all picture, if there is one."""
    if cameras.picture is None:
        return cameras.intrinsics[0]
    height, width = cameras.image_size
    is_whole = (cameras.picture == cameras.picture.new_tensor([0, 0, width, height])).all(dim=1)
    return cameras.intrinsics[int(is_whole.int().argmax())]


def write_frames(
    scan: OpenScan, folder: Path, *, image_size: tuple[int, int], max_frames: int | None
) -> tuple[list[int], dict[str, str]]:
    """Write the chosen frames and their poses; a damaged frame is replaced by the nearest one left.

    Args:
        scan: an open scan.
        folder: of the prepared scan; gets ``color/`` and ``pose/``.
        image_size: ``(H, W)``.
        max_frames: at most so many, evenly spread; None for all.

    Returns:
        the positions that were written, ascending, and what is wrong with each damaged one, by its name.
    """
    (folder / "color").mkdir()
    (folder / "pose").mkdir()
    names = frame_names(scan.frame_id)
    damaged: dict[int, str] = {}
    taken: set[int] = set()
    chosen = choose_frames(len(names), max_frames)
    reserved = set(chosen)

    def write(position: int) -> bool:
        try:
            content, ending = encoded_frame(scan, position, image_size)
        except DataError as error:
            damaged[position] = str(error)
            return False
        (folder / "color" / f"{names[position]}{ending}").write_bytes(content)
        pose = matrix_text(scan.world_from_camera[position])
        (folder / "pose" / f"{names[position]}.txt").write_text(pose, encoding="ascii")
        taken.add(position)
        return True

    for position in chosen:
        if not write(position):
            spare = (p for p in nearest_first(position, len(names)) if p not in reserved and p not in damaged)
            next((p for p in spare if p not in taken and write(p)), None)
    return sorted(taken), {scan.frame_id[p]: damaged[p] for p in sorted(damaged)}


def choose_frames(count: int, max_frames: int | None) -> list[int]:
    """Return the positions of at most ``max_frames`` evenly spread ones of ``count`` frames."""
    if max_frames is None or count <= max_frames:
        return list(range(count))
    return choose_even(count, max_frames).tolist()


def frame_names(frame_ids: Sequence[str]) -> list[str]:
    """Return the number in each frame's name, ``000010`` becomes ``10``; the names if two have the same.

    Names with a time, as ``41254925_3211.498``, stay: what is behind the point does not tell their order.
    """
    if any(re.search(r"\d\.\d", name) for name in frame_ids):
        return list(frame_ids)
    short = []
    for name in frame_ids:
        numbers = re.findall(r"\d+", name)
        short.append(str(int(numbers[-1])) if numbers else name)
    return short if len(set(short)) == len(short) else list(frame_ids)


def encoded_frame(scan: OpenScan, position: int, image_size: tuple[int, int]) -> tuple[bytes, str]:
    """Return a frame of the prepared size and its ending, ``.jpg`` or ``.png``.

    A stored frame that has the size already comes as it is, after it was decoded to see that it is whole.

    Args:
        scan: an open scan.
        position: of the frame in it.
        image_size: ``(H, W)``.

    Raises:
        DataError: the frame is truncated, damaged, or of another size than the others.
    """
    stored = scan.color_bytes(position) if scan.image_size == image_size else None
    if stored is not None:
        scan.read_color(position)
        return stored, ".png" if stored.startswith(_PNG) else ".jpg"
    file = BytesIO()
    Image.fromarray(scan.read_color(position, image_size)).save(file, "JPEG", quality=JPEG_QUALITY)
    return file.getvalue(), ".jpg"


def nearest_first(position: int, count: int) -> Iterator[int]:
    """Yield the positions from 0 to ``count`` - 1, those near ``position`` first."""
    yield from sorted(range(count), key=lambda other: (abs(other - position), other))


def matrix_text(matrix: Tensor) -> str:
    """Return a matrix as lines of numbers that read back as the same float64."""
    return "".join(" ".join(repr(value) for value in row) + "\n" for row in matrix.double().tolist())


def homogeneous(intrinsics: Tensor) -> Tensor:
    """Return ``(3, 3)`` intrinsics as the 4×4 of ScanNet's files."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = intrinsics
    return matrix
