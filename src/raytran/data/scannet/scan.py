# SPDX-License-Identifier: Apache-2.0
"""Scans in every form in which ScanNet is released or exported: folders of frames and recordings."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.data.images import (
    OrientationTags,
    decode_image,
    first_header,
    kept_bytes,
    orientation_tags,
    white_level,
)
from raytran.data.scan import LOST, NO_IMAGE, NO_POSE, OpenScan, even_views, numbers_first
from raytran.data.scannet.layout import Listing, find_layout, recognise
from raytran.data.scannet.sens import SensFile
from raytran.data.scannet.text import (
    are_rigid,
    axis_alignment,
    check_intrinsics,
    fits_better,
    read_header,
    read_intrinsics,
    read_matrix,
)
from raytran.errors import DataError
from raytran.structs import Views

_log = logging.getLogger(__name__)

CUT = "the file ends here"
"""Reason why the frames after the end of a damaged recording are dropped."""

_NO_MATRIX = np.full((4, 4), np.nan)


@dataclass(frozen=True, kw_only=True)
class Scan(OpenScan):
    """The usable frames of a folder.

    Attributes:
        folder: where it lies.
        image_path: file of each usable frame.
        tags: EXIF orientations of the images, if any is known; None: they are read as they are stored.
    """

    folder: Path
    image_path: tuple[Path, ...]
    tags: OrientationTags | None = None

    @property
    def path(self) -> Path:
        """The scan's folder."""
        return self.folder

    def color_bytes(self, index: int) -> bytes | None:
        """See ``OpenScan``."""
        path = self.image_path[index]
        if self._turn(index) != 1:
            return None
        try:
            return kept_bytes(path.read_bytes())
        except OSError as error:
            raise DataError(
                f"cannot read the image {path} ({error.strerror}): copy or export it again"
            ) from error

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        path = self.image_path[index]
        image = decode_image(
            path,
            name=str(path),
            image_size=image_size,
            stored=self.image_size,
            orientation=self._turn(index),
            white=lambda: self._white,
        )
        return image.permute(1, 2, 0).numpy()

    def close(self) -> None:
        """Do nothing: no file is open."""

    @cached_property
    def _white(self) -> int:
        return white_level(self.image_path)

    def _turn(self, index: int) -> int:
        return 1 if self.tags is None else self.tags.turn(index)


@dataclass(frozen=True, kw_only=True)
class SensScan(OpenScan):
    """The usable frames of a ``.sens`` recording.

    Attributes:
        file: the open recording.
        file_index: number of each usable frame in it.
    """

    file: SensFile
    file_index: tuple[int, ...]

    @property
    def path(self) -> Path:
        """The recording."""
        return self.file.path

    def color_bytes(self, index: int) -> bytes | None:
        """See ``OpenScan``."""
        return self.file.color_bytes(self.file_index[index])

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        return self.file.read_color(self.file_index[index], image_size)

    def close(self) -> None:
        """Close the recording."""
        self.file.close()


def read_scan(folder: Path, *, header: Path | None = None, any_size: bool = False) -> Scan:
    """Read a scan's cameras and the list of its frames; images are read later.

    A frame without an image or with a pose that is no rigid motion (ScanNet writes ``-inf`` where tracking
    was lost) is dropped, and the reason is recorded.

    Args:
        folder: a scan in one of the exported forms of ``layout.FORMS``.
        header: its ``<scan>.txt``; if None the one in the folder, which may be missing.
        any_size: accept intrinsics for another image size, as the data doctor does to name the fault.

    Raises:
        DataError: the folder or a part of it is missing, no pose is valid, or the intrinsics are for another
            image size.
    """
    layout = find_layout(Path(folder))
    folder = layout.scan
    images, pose_files = layout.images(), layout.poses()
    complete = sorted(images.keys() & pose_files.keys(), key=numbers_first)
    dropped = {name: NO_IMAGE for name in pose_files.keys() - images.keys()}
    dropped |= {name: NO_POSE for name in images.keys() - pose_files.keys()}
    matrices = [read_matrix(pose_files[name]) for name in complete]
    poses = np.array([_NO_MATRIX if matrix is None else matrix for matrix in matrices]).reshape(-1, 4, 4)
    rigid = are_rigid(poses)
    dropped |= {name: LOST for name, is_rigid in zip(complete, rigid, strict=True) if not is_rigid}
    names = [name for name, is_rigid in zip(complete, rigid, strict=True) if is_rigid]
    if not names:
        raise DataError(
            f"none of the {len(dropped)} frames in {folder} has an image and a valid pose: check that each "
            "image has a text file of its name with a finite 4x4 camera-to-world matrix"
        )
    header = header or folder / f"{folder.name}.txt"
    facts = read_header(header)
    paths = tuple(images[name] for name in names)
    intrinsics_file = layout.intrinsics()
    matrix = read_intrinsics(intrinsics_file)
    shown = first_header(paths)
    image_size, tags = shown.size, None
    if fits_better(matrix, shown.shown_size, shown.size):
        # Of pictures on their side, the intrinsics are for those that an EXIF orientation turns upright.
        image_size, tags = shown.shown_size, orientation_tags(paths, applied=True)
    return Scan(
        scene_id=folder.name,
        folder=folder,
        frame_id=tuple(names),
        image_path=paths,
        tags=tags,
        world_from_camera=torch.from_numpy(poses[rigid]),
        intrinsics=check_intrinsics(
            matrix,
            intrinsics_file,
            image_size=image_size,
            header=facts,
            any_size=any_size,
        ),
        image_size=image_size,
        axis_alignment=axis_alignment(facts, header),
        dropped={name: dropped[name] for name in sorted(dropped, key=numbers_first)},
    )


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
