# SPDX-License-Identifier: Apache-2.0
"""A recording: frames with poses and lenses as a reader of some format returns them, and the scan they make.

What stands at the end, for the numbers in JSON objects, trusts nothing that a file says.
"""

from __future__ import annotations

import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.capture.lens import (
    Lens,
    UnfitLens,
    center_fault,
    check_lens,
    needs_resampling,
    pinhole_of,
    resample,
)
from raytran.data.images import (
    ImageHeader,
    OrientationTags,
    box_within,
    decode_image,
    fill_up,
    has_shape,
    is_turned,
    kept_bytes,
    read_header,
    white_level,
)
from raytran.data.scan import NEEDS_HEIF, NO_IMAGE, OTHER_SHAPE, TURNED, OpenScan, none_usable, numbers_first
from raytran.data.scannet.text import pose_faults
from raytran.errors import ConfigError, DataError
from raytran.geometry.camera import is_off_center
from raytran.limits import Quantity, as_number, as_numbers

_log = logging.getLogger(__name__)

Axes = Literal["opencv", "opengl"]
"""Axes of a camera: x right, y down, z forward; or x right, y up, z backward."""

UNREADABLE = "image cannot be read"
NO_LENS = "impossible intrinsics"
NO_ENTRY = "entry is damaged"
"""Reasons for which a frame is dropped, beside those of ``raytran.data.scan``."""

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy of the stored images, pixels, as a user types them."""


@dataclass(frozen=True)
class Frame:
    """One image with its pose and lens.

    Attributes:
        name: of the frame; fit for a file name.
        image: its file, or the video it is in.
        world_from_camera: ``(4, 4)`` float64, unit and axes of the recording.
        lens: for the image size that the recording states.
        number: of the frame in a video.
    """

    name: str
    image: Path
    world_from_camera: NDArray[np.float64]
    lens: Lens
    number: int = 0


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What a reader returns.

    Attributes:
        path: the file that lists the frames, to be named in messages.
        scene_id: name of the scan.
        frames: at least one.
        axes: camera axes of the poses.
        up: direction of up in the world, ``(3,)``, if the format promises one.
        metric: whether the format promises metres.
        aligned: whether its worlds mostly have an axis that is up.
        honours_exif: whether its programs turn images by their EXIF orientation before they work on them.
        dropped: reason for each image without a pose and each pose without an image.
    """

    path: Path
    scene_id: str
    frames: tuple[Frame, ...]
    axes: Axes = "opencv"
    up: tuple[float, float, float] | None = None
    metric: bool = False
    aligned: bool = False
    honours_exif: bool = False
    dropped: dict[str, str] = field(default_factory=dict)


class FrameList:
    """Collects the frames of a recording; damage to the entry of one leaves that one out, with the reason.

    Attributes:
        frames: collected so far.
        dropped: reason for each frame that was left out.
    """

    def __init__(self, dropped: Mapping[str, str] | None = None) -> None:
        self.frames: list[Frame] = []
        self.dropped: dict[str, str] = dict(dropped or {})
        self._first: DataError | None = None

    @contextmanager
    def sparing(self, name: str, reason: str) -> Iterator[None]:
        """Leave a frame out, for a reason, if its part of a file turns out to be damaged."""
        try:
            yield
        except DataError as error:
            self.dropped[name] = reason
            self._first = self._first or error

    def checked(self) -> tuple[Frame, ...]:
        """Return the frames.

        Raises:
            DataError: all of them are damaged; it is the error of the first.
        """
        if not self.frames and self._first is not None:
            raise self._first
        return tuple(self.frames)


class FrameImages(ABC):
    """The images of a recording's frames, read one by one."""

    @property
    def tags(self) -> OrientationTags | None:
        """Which side of each is up by its file, if a file says that it is not the top."""
        return None

    def with_tags(self, tags: OrientationTags) -> FrameImages:
        """Return the same images, turned as ``tags`` says when they are read."""
        raise NotImplementedError

    @abstractmethod
    def read(
        self, index: int, image_size: tuple[int, int] | None, stored: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """Return ``(H, W, 3)`` RGB, resized to ``image_size`` if given.

        Raises:
            DataError: it is damaged or of another size than ``stored``.
        """

    def encoded(self, index: int) -> bytes | None:
        """Return the file's content, if that is a JPEG or PNG whose pixels are used as they are, else None.

        Raises:
            DataError: it cannot be read.
        """
        return None

    def close(self) -> None:
        """Close the file, if one is open."""
        return


@dataclass(frozen=True)
class ImageFiles(FrameImages):
    """Images in files of their own."""

    paths: tuple[Path, ...]
    orientations: OrientationTags | None = None

    @property
    def tags(self) -> OrientationTags | None:
        """See ``FrameImages``."""
        return self.orientations

    def with_tags(self, tags: OrientationTags) -> ImageFiles:
        """See ``FrameImages``."""
        return replace(self, orientations=tags)

    def read(
        self, index: int, image_size: tuple[int, int] | None, stored: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """See ``FrameImages``."""
        path = self.paths[index]
        image = decode_image(
            path,
            name=str(path),
            image_size=image_size,
            stored=stored,
            orientation=self._turn(index),
            white=lambda: self._white,
        )
        return image.permute(1, 2, 0).numpy()

    def encoded(self, index: int) -> bytes | None:
        """See ``FrameImages``."""
        if self._turn(index) != 1:
            return None
        try:
            return kept_bytes(self.paths[index].read_bytes())
        except OSError as error:
            raise DataError(
                f"cannot read the image {self.paths[index]} ({error.strerror}): copy or export it again"
            ) from error

    @cached_property
    def _white(self) -> int:
        return white_level(self.paths)

    def _turn(self, index: int) -> int:
        return 1 if self.orientations is None else self.orientations.turn(index)


@dataclass(frozen=True, kw_only=True)
class RecordedScan(OpenScan):
    """The usable frames of a recording, each as the image of a pinhole camera.

    Attributes:
        listed_in: the file that lists the frames.
        images: of the frames, as stored.
        lens: of each frame, for the stored size of its image.
        pinhole: of each frame, for the same size; images of lenses that distort are resampled to it. Their
            ``intrinsics`` are this camera's, for the image brought to ``image_size``.
    """

    listed_in: Path
    images: FrameImages
    lens: tuple[Lens, ...]
    pinhole: tuple[Lens, ...]

    @property
    def path(self) -> Path:
        """The file that lists the frames."""
        return self.listed_in

    def color_bytes(self, index: int) -> bytes | None:
        """See ``OpenScan``; None for an image that is resampled."""
        lens = self.lens[index]
        if lens.size != self.image_size or needs_resampling(lens, self.pinhole[index]):
            return None
        return self.images.encoded(index)

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        lens, pinhole = self.lens[index], self.pinhole[index]
        is_whole = has_shape(lens.size, self.image_size)
        image = self.images.read(index, (image_size or self.image_size) if is_whole else None, lens.size)
        image = resample(image, lens, pinhole) if needs_resampling(lens, pinhole) else image
        if is_whole:
            return image
        return fill_up(image, box_within(lens.size, self.image_size), self.image_size, image_size)

    def close(self) -> None:
        """Close the video, if it is one."""
        self.images.close()


def open_recording(recording: Recording) -> RecordedScan:
    """Return the scan of a recording whose images are files.

    Raises:
        DataError: see ``build_scan``.
    """
    turns: dict[Path, tuple[int, bool]] = {}

    def size_of(frame: Frame) -> tuple[int, int] | str:
        if not os.path.isfile(frame.image):  # also if its name is too long to be one
            return NO_IMAGE
        try:
            header = read_header(frame.image)
        except DataError:
            return UNREADABLE
        except ConfigError:
            return NEEDS_HEIF
        as_shown = is_for_shown(frame.lens.size, header, default=recording.honours_exif)
        turns[frame.image] = header.orientation, as_shown
        return header.shown_size if as_shown else header.size

    def open_images(frames: list[Frame]) -> ImageFiles:
        paths = tuple(frame.image for frame in frames)
        orientation, applied = zip(*(turns[path] for path in paths), strict=True)
        has_tags = any(tag != 1 for tag in orientation)
        return ImageFiles(paths, OrientationTags(orientation, applied) if has_tags else None)

    return build_scan(recording, size_of, open_images)


def is_for_shown(size: tuple[int, int], header: ImageHeader, *, default: bool) -> bool:
    """Whether intrinsics for ``size`` (H, W) are for the image turned by its EXIF orientation.

    Where the aspect does not tell, the format's default does.
    """
    fits_shown, fits_stored = (
        min(size) > 0 and has_shape(of_image, size) for of_image in (header.shown_size, header.size)
    )
    return header.orientation != 1 and (default if fits_shown == fits_stored else fits_shown)


def build_scan(
    recording: Recording,
    size_of: Callable[[Frame], tuple[int, int] | str],
    open_images: Callable[[list[Frame]], FrameImages],
) -> RecordedScan:
    """Return the scan of a recording.

    Frames without an image, those whose pose is no rigid motion, and those whose lens cannot have taken the
    image are dropped. A lens for a larger or smaller size of the same image is scaled to the stored one. Each
    frame keeps its own intrinsics; images are brought to the most frequent size, those of another shape
    filled up.

    Args:
        recording: what a reader returned.
        size_of: ``(H, W)`` of a frame's image, or the reason for which the frame is dropped.
        open_images: gives the images of the usable frames.

    Raises:
        ConfigError: a lens distorts and pycolmap is not installed.
        DataError: no frame is left.
    """
    frames, lenses, dropped = _usable(recording, size_of)
    sizes = [lens.size for lens in lenses]
    image_size = max(sorted(set(sizes)), key=sizes.count)
    pinholes = [pinhole_of(lens) for lens in lenses]
    boxes = [box_within(size, image_size) for size in sizes]
    matrices = [_brought_to(pinhole, box) for pinhole, box in zip(pinholes, boxes, strict=True)]
    is_whole = all(has_shape(size, image_size) for size in sizes)
    _report_cameras(recording, lenses, image_size)
    poses = np.array([frame.world_from_camera for frame in frames])
    return RecordedScan(
        scene_id=recording.scene_id,
        listed_in=recording.path,
        frame_id=tuple(frame.name for frame in frames),
        world_from_camera=torch.from_numpy(poses),
        intrinsics=torch.stack(matrices),
        image_size=image_size,
        picture=None if is_whole else torch.tensor(boxes, dtype=torch.float64),
        axis_alignment=torch.eye(4, dtype=torch.float64),
        dropped={name: dropped[name] for name in sorted(dropped, key=numbers_first)},
        images=open_images(frames),
        lens=tuple(lenses),
        pinhole=tuple(pinholes),
    )


def _report_cameras(recording: Recording, lenses: list[Lens], image_size: tuple[int, int]) -> None:
    """Log how many images are filled up, and how many look like crops."""
    others = sum(not has_shape(lens.size, image_size) for lens in lenses)
    if others:
        _log.info(
            "%s: %d of %d images are of another shape than %dx%d and are filled up to it",
            *(recording.scene_id, others, len(lenses), image_size[1], image_size[0]),
        )
    cropped = [lens for lens in lenses if is_off_center(lens.center, lens.size)]
    if cropped:
        (cx, cy), (height, width) = cropped[0].center, cropped[0].size
        _log.warning(
            "%s: %d of %d images have their principal point far from the middle, the first at (%.0f, %.0f) "
            "of %dx%d, and are taken for crops: if they are none, give the intrinsics of the stored images",
            *(recording.scene_id, len(cropped), len(lenses), cx, cy, width, height),
        )


def _brought_to(pinhole: Lens, box: tuple[int, int, int, int]) -> Tensor:
    """Return the ``(3, 3)`` intrinsics of images resized into a box (left, top, right, bottom)."""
    left, top, right, bottom = box
    matrix = pinhole.scaled_to((bottom - top, right - left)).matrix
    matrix[0, 2] += left
    matrix[1, 2] += top
    return matrix


def _usable(
    recording: Recording, size_of: Callable[[Frame], tuple[int, int] | str]
) -> tuple[list[Frame], list[Lens], dict[str, str]]:
    """Return the usable frames in the order of their names, their lenses, and the reasons for the others.

    Raises:
        DataError: there is none.
    """
    dropped = dict(recording.dropped)
    unfit: dict[str, UnfitLens] = {}
    frames: list[Frame] = []
    lenses: list[Lens] = []
    ordered = sorted(recording.frames, key=lambda frame: numbers_first(frame.name))
    faults = pose_faults(np.array([frame.world_from_camera for frame in ordered]).reshape(-1, 4, 4))
    for frame, fault in zip(ordered, faults, strict=True):
        size = size_of(frame) if fault is None else fault
        if isinstance(size, str):
            dropped[frame.name] = size
            continue
        try:
            lenses.append(_lens_for_size(frame, size, recording.path))
            frames.append(frame)
        except UnfitLens as error:
            unfit[frame.name] = error
    # Where most images have it there, a principal point far from the middle is a mistake.
    off_center = [
        center_fault(lens, _camera_of(frame, recording.path))
        for frame, lens in zip(frames, lenses, strict=True)
    ]
    if sum(fault is not None for fault in off_center) > len(frames) / 2:
        unfit |= {
            frame.name: fault for frame, fault in zip(frames, off_center, strict=True) if fault is not None
        }
        lenses = [lens for lens, fault in zip(lenses, off_center, strict=True) if fault is None]
        frames = [frame for frame, fault in zip(frames, off_center, strict=True) if fault is None]
    dropped |= {name: error.reason for name, error in unfit.items()}
    if frames:
        return frames, lenses, dropped
    if len(unfit) > len(dropped) / 2:
        raise next(iter(unfit.values()))
    raise none_usable(recording.path, dropped)


def _lens_for_size(frame: Frame, size: tuple[int, int], listed_in: Path) -> Lens:
    """Return the frame's lens for the stored size ``(H, W)`` of its image.

    Raises:
        UnfitLens: it is none, or one for images of another shape.
    """
    height, width = frame.lens.size
    if min(height, width) > 0 and not has_shape(size, frame.lens.size):
        turned = is_turned(size, frame.lens.size)
        raise UnfitLens(
            f"image {frame.name} is {size[1]}x{size[0]} and its intrinsics in {listed_in} are for "
            f"{width}x{height}{', turned by 90°' if turned else ''}: give the images that the intrinsics "
            "were made for",
            TURNED if turned else OTHER_SHAPE,
        )
    lens = frame.lens.scaled_to(size) if min(height, width) > 0 else frame.lens
    return check_lens(lens, _camera_of(frame, listed_in))


def _camera_of(frame: Frame, listed_in: Path) -> str:
    return f"the camera of {frame.name} in {listed_in}"


def typed_lens(intrinsics: Intrinsics, *sizes: tuple[int, int]) -> Lens:
    """Return the lens that a user typed for images of a stored size ``(H, W)``; of several, the nearest one.

    Raises:
        DataError: no lens of such images has such intrinsics.
    """
    fx, fy, cx, cy = intrinsics
    size = nearest_size(np.array([cx, cy]), sizes)
    return check_lens(Lens(size, (fx, fy), (cx, cy)), f"intrinsics={fx:g},{fy:g},{cx:g},{cy:g}")


def nearest_size(center: NDArray[np.float64], sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Return the first of some sizes ``(H, W)`` in whose middle a principal point (cx, cy) lies best."""
    if len(set(sizes)) == 1 or center.shape != (2,):
        return sizes[0]
    return min(sizes, key=lambda size: float(np.abs(center / np.array(size[::-1]) - 0.5).max()))


def number(
    content: Mapping[str, Any], key: str, quantity: Quantity, where: str, default: float | None = None
) -> float:
    """Return the number at a key of a JSON object, within the bounds of what it measures.

    Args:
        content: the object.
        key: name of the value.
        quantity: what it measures.
        where: name of the object in messages.
        default: value if the key is missing; None: it must be there.

    Raises:
        DataError: it is missing, no number, or out of bounds.
    """
    if key not in content and default is None:
        raise DataError(f"{where} has no {key} where a number is needed: export it again")
    return as_number(content.get(key, default), quantity, f"{key} in {where}")


def numbers(
    content: Mapping[str, Any], key: str, quantity: Quantity, where: str, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Return the array at a key of a JSON object; NaN where one is out of bounds, as of a lost pose.

    Args:
        content: the object.
        key: name of the value.
        quantity: what each number measures.
        where: name of the object in messages.
        shape: of the array; a flat list of as many numbers will do.

    Raises:
        DataError: it is missing or of another size.
    """
    if key not in content:
        raise DataError(f"{where} has no {key} where numbers are needed: export it again")
    return as_numbers(content[key], shape, quantity, f"{key} in {where}", lost=True)
