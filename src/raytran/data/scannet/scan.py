# SPDX-License-Identifier: Apache-2.0
"""Scans in every form in which ScanNet is released or exported: folders of frames and recordings."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import compress
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.data.images import (
    OrientationTags,
    decode_image,
    has_shape,
    image_headers,
    is_turned,
    kept_bytes,
    most_frequent_header,
    orientation_tags,
    white_level,
)
from raytran.data.scan import (
    NO_IMAGE,
    NO_MATRIX,
    NO_POSE,
    OTHER_SHAPE,
    TURNED,
    OpenScan,
    even_views,
    none_usable,
    numbers_first,
)
from raytran.data.scannet.layout import Layout, Listing, find_layout, recognise
from raytran.data.scannet.sens import SensFile
from raytran.data.scannet.text import (
    axis_alignment,
    camera_matrix,
    check_intrinsics,
    fits_better,
    header_intrinsics,
    pose_faults,
    read_frame_cameras,
    read_header,
    read_intrinsics,
    read_pose,
)
from raytran.errors import DataError
from raytran.structs import Views

_log = logging.getLogger(__name__)

CUT = "the file ends here"
"""Reason why the frames after the end of a damaged recording are dropped."""

_SIZES_TRIED = 8
"""Most sizes of images to which the intrinsics of a folder are held."""

_MAX_APART, _OTHER_SIZE = 0.01, 0.2
"""Relative differences between two files of intrinsics: from the first on it is said, from the second on they
are for images of other sizes."""

_NO_MATRIX = np.full((4, 4), np.nan)


@dataclass(frozen=True, kw_only=True)
class Scan(OpenScan):
    """The usable frames of a folder.

    Attributes:
        folder: where it lies.
        image_path: file of each usable frame.
        other_size: ``(H, W)`` of the images that are not stored in ``image_size``, by their position; they
            have the same aspect.
        tags: EXIF orientations of the images, if any is known; None: they are read as they are stored.
    """

    folder: Path
    image_path: tuple[Path, ...]
    other_size: dict[int, tuple[int, int]] = field(default_factory=dict)
    tags: OrientationTags | None = None

    @property
    def path(self) -> Path:
        """The scan's folder."""
        return self.folder

    def color_bytes(self, index: int) -> bytes | None:
        """See ``OpenScan``."""
        if index in self.other_size:
            return None
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
        stored = self.other_size.get(index, self.image_size)
        image = decode_image(
            path,
            name=str(path),
            image_size=image_size or (self.image_size if index in self.other_size else None),
            stored=stored,
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


def read_scan(
    folder: Path,
    *,
    header: Path | None = None,
    any_size: bool = False,
    intrinsics: tuple[float, float, float, float] | None = None,
) -> Scan:
    """Read a scan's cameras and the list of its frames; images are read later.

    A frame without an image, with a pose that is no rigid motion (ScanNet writes ``-inf`` where tracking was
    lost), or with an image of another shape than the intrinsics are for is dropped, and the reason is
    recorded. Images of the same shape in another size are used: the intrinsics follow.

    Args:
        folder: a scan in one of the exported forms of ``layout.FORMS``.
        header: its ``<scan>.txt``; if None the one in the folder, which may be missing.
        any_size: accept intrinsics for another image size, as the data doctor does to name the fault.
        intrinsics: fx, fy, cx, cy of the stored images, in place of those in files.

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
    matrices = [read_pose(pose_files[name]) for name in complete]
    poses = np.array([_NO_MATRIX if matrix is None else matrix for matrix in matrices]).reshape(-1, 4, 4)
    faults = [
        NO_MATRIX if matrix is None else fault
        for matrix, fault in zip(matrices, pose_faults(poses), strict=True)
    ]
    dropped |= {name: fault for name, fault in zip(complete, faults, strict=True) if fault is not None}
    names = [name for name in complete if name not in dropped]
    if not names:
        raise none_usable(folder, dropped)
    header = header or folder / f"{folder.name}.txt"
    facts = read_header(header)
    matrix, intrinsics_file = _intrinsics(layout, header, facts, intrinsics)
    headers = image_headers([images[name] for name in names])
    common = most_frequent_header([images[name] for name in names], headers)
    # Of pictures on their side, intrinsics may be for those that an EXIF orientation turns upright.
    is_shown = fits_better(matrix, common.shown_size, common.size)
    found = [each if each is None else each.shown_size if is_shown else each.size for each in headers]
    per_frame = layout.frame_cameras() if intrinsics is None else None
    any_size = any_size or per_frame is not None
    image_size, of_all = _fitting_size(
        [size for size in found if size is not None],
        partial(check_intrinsics, matrix, intrinsics_file, header=facts, any_size=any_size),
    )
    # An image whose header cannot be read is named when it is read.
    sizes = [size or image_size for size in found]
    fits = [has_shape(size, image_size) for size in sizes]
    for name, size, has_right_shape in zip(names, sizes, fits, strict=True):
        if not has_right_shape:
            dropped[name] = TURNED if is_turned(size, image_size) else OTHER_SHAPE
    names = list(compress(names, fits))
    sizes = [size for size in sizes if has_shape(size, image_size)]
    # In images of one aspect, brought to one size, all have the same, unless a file says otherwise.
    of_each, picture = of_all.expand(len(names), 3, 3), None
    if per_frame is not None:
        of_each, picture = read_frame_cameras(per_frame, names)
    paths = tuple(images[name] for name in names)
    return Scan(
        scene_id=folder.name,
        folder=folder,
        frame_id=tuple(names),
        image_path=paths,
        tags=orientation_tags(list(compress(headers, fits)), applied=True) if is_shown else None,
        world_from_camera=torch.from_numpy(poses[[fault is None for fault in faults]][fits]),
        intrinsics=of_each,
        picture=picture,
        image_size=image_size,
        other_size={i: size for i, size in enumerate(sizes) if size != image_size},
        axis_alignment=axis_alignment(facts, header),
        dropped={name: dropped[name] for name in sorted(dropped, key=numbers_first)},
    )


def _fitting_size(
    sizes: Sequence[tuple[int, int]], check: Callable[..., Tensor]
) -> tuple[tuple[int, int], Tensor]:
    """Return the most frequent size of images that the intrinsics fit, and the intrinsics.

    Raises:
        DataError: they fit none; the error is that of the most frequent size.
    """
    first_error: DataError | None = None
    for size, _ in Counter(sizes).most_common(_SIZES_TRIED):
        try:
            return size, check(image_size=size)
        except DataError as error:
            first_error = first_error or error
    raise first_error or DataError("a scan without images has no intrinsics")


def _intrinsics(
    layout: Layout,
    header: Path,
    facts: dict[str, str],
    typed: tuple[float, float, float, float] | None,
) -> tuple[NDArray[np.float64], Path]:
    """Return the 4×4 camera matrix of a folder, and where it was read.

    What the user typed comes first, then the file of intrinsics; ``<scan>.txt`` is only held against it.

    Raises:
        DataError: there is none, or it is damaged.
    """
    if typed is not None:
        return camera_matrix(*typed), Path("intrinsics=" + ",".join(f"{value:g}" for value in typed))
    path = layout.intrinsics()
    stated = header_intrinsics(facts)
    depth = layout.depth_intrinsics()
    if not path.is_file() and depth is not None:
        raise DataError(
            f"{depth} is of the depth camera, and {path.name} of the colour camera is missing: export it, or "
            "give intrinsics=fx,fy,cx,cy"
        )
    matrix = read_intrinsics(path)
    if stated is not None and np.isfinite(matrix).all():
        apart = float((np.abs(matrix - stated) / np.abs(stated).clip(min=1.0))[:2].max())
        # More is another size of the images, which is judged by the principal point.
        if _MAX_APART < apart < _OTHER_SIZE:
            _log.warning(
                "%s and %s differ by %.1f %% in the intrinsics of the colour camera: the former are taken",
                *(path, header.name, 100 * apart),
            )
    return matrix, path


def read_sens(
    path: Path,
    *,
    scene_id: str | None = None,
    header: Path | None = None,
    any_size: bool = False,
    intrinsics: tuple[float, float, float, float] | None = None,
) -> SensScan:
    """Open a ``.sens`` recording; frames are dropped as in ``read_scan``.

    Args:
        path: the file.
        scene_id: name of the scan; if None the file's without its ending.
        header: its ``<scan>.txt``; if None the one beside the file, which may be missing.
        any_size: see ``read_scan``.
        intrinsics: fx, fy, cx, cy of the stored images, in place of the recording's.

    Raises:
        DataError: see ``SensFile``; no pose is valid, or the intrinsics are for another image size.
    """
    file = SensFile(path)
    try:
        scene_id = scene_id or path.stem
        poses = file.world_from_camera
        reasons = [
            fault if has_image else NO_IMAGE
            for fault, has_image in zip(pose_faults(poses), file.num_color_bytes > 0, strict=True)
        ]
        usable = [i for i, reason in enumerate(reasons) if reason is None]
        dropped = {str(i): reason for i, reason in enumerate(reasons) if reason is not None}
        if file.damage is not None:
            _log.warning("%s", file.damage)
            dropped[str(len(file))] = CUT
        if not usable:
            raise none_usable(path, dropped)
        header = header or path.with_name(f"{scene_id}.txt")
        facts = read_header(header)
        return SensScan(
            scene_id=scene_id,
            frame_id=tuple(map(str, usable)),
            world_from_camera=torch.from_numpy(poses[usable]),
            intrinsics=check_intrinsics(
                file.color_intrinsics if intrinsics is None else camera_matrix(*intrinsics),
                path,
                image_size=file.color_size,
                header=facts,
                any_size=any_size,
            ).expand(len(usable), 3, 3),
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


def open_scan(path: Path, intrinsics: tuple[float, float, float, float] | None = None) -> OpenScan:
    """Open a scan in whatever form: a folder of frames, a folder with a ``.sens`` recording, or that file.

    Args:
        path: the folder or file.
        intrinsics: fx, fy, cx, cy of the stored images, in place of those in files.

    Raises:
        DataError: there is none, or see ``read_scan`` and ``read_sens``.
    """
    path = Path(path)
    if path.is_file():
        return read_sens(path, intrinsics=intrinsics)
    if path.is_dir():
        listing = Listing.of(path)
        recordings = sorted(name for name in listing.files if name.endswith(".sens"))
        if recordings and recognise(listing) is None:
            if len(recordings) > 1:
                raise DataError(f"{path} holds {len(recordings)} recordings: give the path of one of them")
            return read_sens(path / recordings[0], intrinsics=intrinsics)
    return read_scan(path, intrinsics=intrinsics)


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
