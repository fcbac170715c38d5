# SPDX-License-Identifier: Apache-2.0
"""Scans in ScanNet's exported layout: ``color/<n>.jpg``, ``pose/<n>.txt``, ``intrinsic/``, ``<scan>.txt``."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.data.images import MIN_VIEWS, read_images, stored_size
from raytran.data.views import choose_even
from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.types import Views

_log = logging.getLogger(__name__)

_OFF_CENTRE = 0.15
"""Largest distance of the principal point from the image centre, in widths or heights."""


@dataclass(frozen=True)
class Scan:
    """The usable frames of one scan.

    Attributes:
        scene_id: name of the scan's folder.
        folder: where it lies.
        frame_id: name of each usable frame's file without its ending, in the order of the numbers in it.
        image_path: ``color`` file of each usable frame.
        world_from_camera: ``(n, 4, 4)`` float64, metres.
        intrinsics: ``(3, 3)`` float64 for images of the stored size, pixels.
        image_size: ``(H, W)`` as stored.
        axis_alignment: ``(4, 4)`` float64, aligned_from_world; identity if the scan has none.
        dropped: reason for each frame that was left out, by frame name.
    """

    scene_id: str
    folder: Path
    frame_id: tuple[str, ...]
    image_path: tuple[Path, ...]
    world_from_camera: Tensor
    intrinsics: Tensor
    image_size: tuple[int, int]
    axis_alignment: Tensor
    dropped: dict[str, str]

    def __len__(self) -> int:
        return len(self.frame_id)


def read_scan(folder: Path) -> Scan:
    """Read a scan's cameras and the list of its frames; images are read later.

    A frame without an image or with a pose that is no rigid motion (ScanNet writes ``-inf`` where tracking
    was lost) is dropped, and the reason kept.

    Args:
        folder: ``…/scans/<scan>``.

    Raises:
        DataError: the folder or a part of it is missing, no pose is valid, or the intrinsics are for another
            image size.
    """
    folder = Path(folder)
    images = _files(folder, "color", (".jpg", ".jpeg", ".png"))
    pose_files = _files(folder, "pose", (".txt",))
    poses: dict[str, NDArray] = {}
    dropped: dict[str, str] = {}
    for name in sorted(images.keys() | pose_files.keys(), key=_numbers_first):
        if name not in images or name not in pose_files:
            dropped[name] = "no image" if name not in images else "no pose"
        elif (pose := _read_matrix(pose_files[name])) is None or not _is_rigid(pose):
            dropped[name] = "pose is not finite or no rigid motion"
        else:
            poses[name] = pose
    if not poses:
        raise DataError(
            f"none of the {len(dropped)} frames in {folder} has an image and a valid pose: "
            "check that pose/<n>.txt holds finite 4x4 camera-to-world matrices named as color/<n>.jpg"
        )
    header = _read_header(folder / f"{folder.name}.txt")
    image_size = stored_size([images[name] for name in poses])
    return Scan(
        scene_id=folder.name,
        folder=folder,
        frame_id=tuple(poses),
        image_path=tuple(images[name] for name in poses),
        world_from_camera=torch.from_numpy(np.stack(list(poses.values()))),
        intrinsics=_read_intrinsics(folder / "intrinsic" / "intrinsic_color.txt", image_size, header),
        image_size=image_size,
        axis_alignment=_axis_alignment(header, folder),
        dropped=dropped,
    )


def load_views(
    folder: str | Path, *, image_size: tuple[int, int], num_views: int
) -> tuple[Views, tuple[str, ...]]:
    """Read evenly spread frames of a scan, without annotation; the same frames as an "even" ``SceneDataset``.

    Args:
        folder: ``…/scans/<scan>``.
        image_size: ``(H, W)`` to which the images are resized; the intrinsics follow.
        num_views: N.

    Returns:
        the views with B = 1 and the name of each frame.

    Raises:
        DataError: see ``read_scan``; or fewer than two images can be read.
    """
    folder = Path(folder)
    scan = read_scan(folder)
    if scan.dropped:
        total = len(scan) + len(scan.dropped)
        reasons = ", ".join(sorted(set(scan.dropped.values())))
        _log.info("%s: dropped %d of %d frames (%s)", folder.name, len(scan.dropped), total, reasons)
    views, used = scan_views(scan, choose_even(len(scan), num_views).tolist(), image_size=image_size)
    return views, tuple(scan.frame_id[i] for i in used)


def scan_views(
    scan: Scan, chosen: Sequence[int], *, image_size: tuple[int, int], min_views: int = MIN_VIEWS
) -> tuple[Views, list[int]]:
    """Read the chosen frames of a scan; an unreadable one is replaced by its nearest readable neighbour.

    Args:
        scan: what ``read_scan`` returned.
        chosen: positions of N frames in it.
        image_size: ``(H, W)`` to which the images are resized; the intrinsics follow.
        min_views: fewest different frames.

    Returns:
        the views with B = 1 and the positions of the frames that were read.

    Raises:
        DataError: fewer than ``min_views`` different frames can be read.
    """
    images, used = read_images(
        scan.image_path, chosen, image_size=image_size, stored=scan.image_size, min_views=min_views
    )
    pose = scan.world_from_camera[used]
    cameras = Cameras(scan.intrinsics.expand(len(used), 3, 3), pose, scan.image_size).scaled_to(image_size)
    return Views(images[None], cameras.intrinsics.float()[None], pose.float()[None]), used


def _files(folder: Path, part: str, endings: tuple[str, ...]) -> dict[str, Path]:
    if not folder.is_dir():
        raise DataError(f"there is no scan folder {folder}: check the path")
    if not (folder / part).is_dir():
        raise DataError(
            f"{folder} has no folder {part}: a scan holds color/<n>.jpg, pose/<n>.txt and intrinsic/"
        )
    return {path.stem: path for path in (folder / part).iterdir() if path.suffix.lower() in endings}


def _numbers_first(name: str) -> list[tuple[int, int, str]]:
    """Key that sorts frame names by the numbers in them: 9 before 10, frame-9 before frame-10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]


def _read_matrix(path: Path) -> NDArray | None:
    """Return the 4×4 matrix in a text file, or None if the file does not hold one."""
    try:
        values = [float(word) for word in path.read_text(encoding="ascii").split()]
        return np.array(values).reshape(4, 4)
    except (OSError, ValueError):
        return None


def _is_rigid(pose: NDArray) -> bool:
    turn = pose[:3, :3]
    return bool(
        np.isfinite(pose).all() and np.abs(turn @ turn.T - np.eye(3)).max() < 0.01 and np.linalg.det(turn) > 0
    )


def _read_header(path: Path) -> dict[str, str]:
    """Return the ``key = value`` lines of ``<scan>.txt``; none if there is no such file."""
    if not path.is_file():
        return {}
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return {
        key.strip(): value.strip() for key, equals, value in (line.partition("=") for line in lines) if equals
    }


def _axis_alignment(header: dict[str, str], folder: Path) -> Tensor:
    if "axisAlignment" not in header:
        return torch.eye(4, dtype=torch.float64)
    try:
        values = [float(word) for word in header["axisAlignment"].split()]
        return torch.tensor(values, dtype=torch.float64).reshape(4, 4)
    except (ValueError, RuntimeError) as error:
        raise DataError(
            f"axisAlignment in {folder / folder.name}.txt is not 16 numbers: mend or remove it"
        ) from error


def _read_intrinsics(path: Path, image_size: tuple[int, int], header: dict[str, str]) -> Tensor:
    """Return ``(3, 3)`` intrinsics after checking that they can belong to images of ``image_size``."""
    matrix = _read_matrix(path)
    if matrix is None or not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
        state = "does not hold a 4x4 camera matrix" if path.is_file() else "is missing"
        raise DataError(f"{path} {state}: write fx, fy, cx, cy of the stored colour images there as 4x4")
    height, width = image_size
    off = _distance_from_centre(matrix, width, height)
    try:
        stated = int(header.get("colorWidth", width)), int(header.get("colorHeight", height))
    except ValueError:
        stated = width, height
    for_stated_size = stated != (width, height) and _distance_from_centre(matrix, *stated) < off
    if off > _OFF_CENTRE or for_stated_size:
        raise DataError(
            f"{path} has its principal point at ({matrix[0, 2]:.1f}, {matrix[1, 2]:.1f}), so it is for "
            f"another image size than the stored {width}x{height}: "
            "scale its first row by W'/W and its second by H'/H"
        )
    return torch.from_numpy(matrix[:3, :3].copy())


def _distance_from_centre(matrix: NDArray, width: int, height: int) -> float:
    return max(abs(matrix[0, 2] / width - 0.5), abs(matrix[1, 2] / height - 0.5))
