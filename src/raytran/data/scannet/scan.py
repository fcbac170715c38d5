# SPDX-License-Identifier: Apache-2.0
"""Scans in every form in which ScanNet is released or exported: folders of frames and recordings."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.data.images import MIN_VIEWS, read_frames, stored_size
from raytran.data.scan import OpenScan, Scan, SensScan
from raytran.data.scannet.layout import Layout, Listing, find_layout, recognise
from raytran.data.scannet.sens import SensFile
from raytran.data.scannet.text import (
    are_rigid,
    axis_alignment,
    check_intrinsics,
    read_header,
    read_intrinsics,
    read_matrix,
)
from raytran.data.views import choose_even
from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.structs import Views

_log = logging.getLogger(__name__)

LOST = "pose is not finite or no rigid motion"
NO_IMAGE = "no image"
NO_POSE = "no pose"
CUT = "the file ends here"
"""Reasons for which a frame is dropped."""

_NO_MATRIX = np.full((4, 4), np.nan)


def read_scan(folder: Path, *, header: Path | None = None, any_size: bool = False) -> Scan:
    """Read a scan's cameras and the list of its frames; images are read later.

    A frame without an image or with a pose that is no rigid motion (ScanNet writes ``-inf`` where tracking
    was lost) is dropped, and the reason kept.

    Args:
        folder: a scan in one of the exported forms of ``scan_layout.FORMS``.
        header: its ``<scan>.txt``; if None the one in the folder, which may be missing.
        any_size: whether intrinsics may be for another image size; the data doctor wants them as they are.

    Raises:
        DataError: the folder or a part of it is missing, no pose is valid, or the intrinsics are for another
            image size.
    """
    return _read_layout(find_layout(Path(folder)), header, any_size)


def read_sens(
    path: Path, *, scene_id: str | None = None, header: Path | None = None, any_size: bool = False
) -> SensScan:
    """Open a ``.sens`` recording; frames are dropped as in ``read_scan``.

    Args:
        path: the file.
        scene_id: name of the scan; if None the file's without its ending.
        header: its ``<scan>.txt``; if None the one beside the file, which may be missing.
        any_size: see ``read_scan``.

    Raises:
        DataError: see ``SensFile``; no pose is valid, or the intrinsics are for another image size.
    """
    file = SensFile(path)
    try:
        scene_id = scene_id or path.stem
        poses = file.world_from_camera
        rigid, has_image = are_rigid(poses), file.num_color_bytes > 0
        usable = np.flatnonzero(rigid & has_image).tolist()
        dropped = {
            str(i): LOST if has_image[i] else NO_IMAGE for i in np.flatnonzero(~(rigid & has_image)).tolist()
        }
        if file.damage is not None:
            _log.warning("%s", file.damage)
            dropped[str(len(file))] = CUT
        if not usable:
            raise DataError(
                f"none of the {len(file)} frames in {path} has an image and a valid pose: download it again"
            )
        header = header or path.with_name(f"{scene_id}.txt")
        facts = read_header(header)
        return SensScan(
            scene_id=scene_id,
            frame_id=tuple(map(str, usable)),
            world_from_camera=torch.from_numpy(poses[usable]),
            intrinsics=check_intrinsics(
                file.color_intrinsics, path, image_size=file.color_size, header=facts, any_size=any_size
            ),
            image_size=file.color_size,
            axis_alignment=axis_alignment(facts, header),
            dropped=dropped,
            damage=file.damage,
            file=file,
            file_index=tuple(usable),
        )
    except BaseException:
        file.close()
        raise


def open_scan(path: Path) -> OpenScan:
    """Open a scan in whatever form: a folder of frames, a folder with a ``.sens`` recording, or that file.

    Raises:
        DataError: there is none, or see ``read_scan`` and ``read_sens``.
    """
    path = Path(path)
    if path.is_file():
        return read_sens(path)
    if path.is_dir():
        listing = Listing.of(path)
        recordings = sorted(name for name in listing.files if name.endswith(".sens"))
        if recordings and recognise(listing) is None:
            if len(recordings) > 1:
                raise DataError(f"{path} holds {len(recordings)} recordings: give the path of one of them")
            return read_sens(path / recordings[0])
    return read_scan(path)


def load_views(
    folder: str | Path, *, image_size: tuple[int, int], num_views: int
) -> tuple[Views, tuple[str, ...]]:
    """Read evenly spread frames of a scan, without annotation; the same frames as an "even" ``SceneDataset``.

    Args:
        folder: ``…/scans/<scan>``, in any form that ``open_scan`` knows.
        image_size: ``(H, W)`` to which the images are resized; the intrinsics follow.
        num_views: N.

    Returns:
        the views with B = 1 and the name of each frame.

    Raises:
        DataError: see ``open_scan``; or fewer than two images can be read.
    """
    with open_scan(Path(folder)) as scan:
        return even_views(scan, image_size=image_size, num_views=num_views)


def even_views(
    scan: OpenScan, *, image_size: tuple[int, int], num_views: int
) -> tuple[Views, tuple[str, ...]]:
    """Read evenly spread frames of an open scan; how many have no image or pose is logged.

    Args:
        scan: of any source.
        image_size: ``(H, W)`` to which the images are resized; the intrinsics follow.
        num_views: N.

    Returns:
        the views with B = 1 and the name of each frame.

    Raises:
        DataError: fewer than two images can be read.
    """
    report_dropped(scan)
    views, used = scan_views(scan, choose_even(len(scan), num_views).tolist(), image_size=image_size)
    return views, tuple(scan.frame_id[i] for i in used)


def report_dropped(scan: OpenScan) -> None:
    """Log how many frames of a scan have no image or pose."""
    if scan.dropped:
        total = len(scan) + len(scan.dropped)
        reasons = ", ".join(sorted(set(scan.dropped.values())))
        _log.info("%s: dropped %d of %d frames (%s)", scan.scene_id, len(scan.dropped), total, reasons)


def scan_views(
    scan: OpenScan, chosen: Sequence[int], *, image_size: tuple[int, int], min_views: int = MIN_VIEWS
) -> tuple[Views, list[int]]:
    """Read the chosen frames of a scan; an unreadable one is replaced by its nearest readable neighbour.

    Args:
        scan: what ``open_scan`` or ``read_scan`` returned.
        chosen: positions of N frames in it.
        image_size: ``(H, W)`` to which the images are resized; the intrinsics follow.
        min_views: fewest different frames.

    Returns:
        the views with B = 1 and the positions of the frames that were read.

    Raises:
        DataError: fewer than ``min_views`` different frames can be read.
    """
    images, used = read_frames(
        lambda index: _as_tensor(scan.read_color(index, image_size)),
        len(scan),
        chosen,
        where=scan.path,
        min_views=min_views,
    )
    pose = scan.world_from_camera[used]
    cameras = Cameras(scan.intrinsics.expand(len(used), 3, 3), pose, scan.image_size).scaled_to(image_size)
    return Views(images[None], cameras.intrinsics.float()[None], pose.float()[None]), used


def _read_layout(layout: Layout, header: Path | None, any_size: bool) -> Scan:
    folder = layout.scan
    images, pose_files = layout.images(), layout.poses()
    both = sorted(images.keys() & pose_files.keys(), key=numbers_first)
    dropped = {name: NO_IMAGE for name in pose_files.keys() - images.keys()}
    dropped |= {name: NO_POSE for name in images.keys() - pose_files.keys()}
    matrices = [read_matrix(pose_files[name]) for name in both]
    poses = np.array([_NO_MATRIX if matrix is None else matrix for matrix in matrices]).reshape(-1, 4, 4)
    rigid = are_rigid(poses)
    dropped |= {name: LOST for name, good in zip(both, rigid, strict=True) if not good}
    names = [name for name, good in zip(both, rigid, strict=True) if good]
    if not names:
        raise DataError(
            f"none of the {len(dropped)} frames in {folder} has an image and a valid pose: check that each "
            "image has a text file of its name with a finite 4x4 camera-to-world matrix"
        )
    header = header or folder / f"{folder.name}.txt"
    facts = read_header(header)
    image_size = stored_size([images[name] for name in names])
    intrinsics = layout.intrinsics()
    return Scan(
        scene_id=folder.name,
        folder=folder,
        frame_id=tuple(names),
        image_path=tuple(images[name] for name in names),
        world_from_camera=torch.from_numpy(poses[rigid]),
        intrinsics=check_intrinsics(
            read_intrinsics(intrinsics), intrinsics, image_size=image_size, header=facts, any_size=any_size
        ),
        image_size=image_size,
        axis_alignment=axis_alignment(facts, header),
        dropped={name: dropped[name] for name in sorted(dropped, key=numbers_first)},
    )


def _as_tensor(image: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)


def numbers_first(name: str) -> list[tuple[int, int, str]]:
    """Key that sorts frame names by the numbers in them: 9 before 10, frame-9 before frame-10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]
