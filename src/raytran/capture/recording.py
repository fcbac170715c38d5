# SPDX-License-Identifier: Apache-2.0
"""A recording: frames with poses and lenses as a reader of some format returns them, and the scan they make.

What stands at the end, for the numbers in JSON objects, trusts nothing that a file says.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.lens import Lens, check_lens, needs_resampling, resample, shared_pinhole
from raytran.data.images import decode_image, stored_size
from raytran.data.scan import NO_IMAGE, OpenScan, none_usable, numbers_first
from raytran.data.scannet.text import pose_faults
from raytran.errors import DataError
from raytran.limits import Quantity, as_number, as_numbers

Axes = Literal["opencv", "opengl"]
"""Axes of a camera: x right, y down, z forward; or x right, y up, z backward."""

UNREADABLE = "image cannot be read"
NO_LENS = "impossible intrinsics"
NO_ENTRY = "entry is damaged"
"""Reasons for which a frame is dropped, beside those of ``raytran.data.scan``."""

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy of the stored images, pixels, as a user types them."""

_SAME_ASPECT = 0.01


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
        dropped: reason for each image without a pose and each pose without an image.
    """

    path: Path
    scene_id: str
    frames: tuple[Frame, ...]
    axes: Axes = "opencv"
    up: tuple[float, float, float] | None = None
    metric: bool = False
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

    @abstractmethod
    def read(
        self, index: int, image_size: tuple[int, int] | None, stored: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """Return ``(H, W, 3)`` RGB, resized to ``image_size`` if given.

        Raises:
            DataError: it is damaged or of another size than ``stored``.
        """

    def encoded(self, index: int) -> bytes | None:
        """Return the JPEG or PNG as stored, or None if it is none.

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

    def read(
        self, index: int, image_size: tuple[int, int] | None, stored: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """See ``FrameImages``."""
        path = self.paths[index]
        image = decode_image(path, name=str(path), image_size=image_size, stored=stored)
        return image.permute(1, 2, 0).numpy()

    def encoded(self, index: int) -> bytes | None:
        """See ``FrameImages``."""
        try:
            return self.paths[index].read_bytes()
        except OSError as error:
            raise DataError(
                f"cannot read the image {self.paths[index]} ({error.strerror}): copy or export it again"
            ) from error


@dataclass(frozen=True, kw_only=True)
class RecordedScan(OpenScan):
    """The usable frames of a recording, all as images of one pinhole camera.

    Attributes:
        listed_in: the file that lists the frames.
        images: of the frames, as stored.
        lens: of each frame, for the stored size of its image.
        pinhole: the camera that ``intrinsics`` describes; images of other lenses are resampled to it.
    """

    listed_in: Path
    images: FrameImages
    lens: tuple[Lens, ...]
    pinhole: Lens

    @property
    def path(self) -> Path:
        """The file that lists the frames."""
        return self.listed_in

    def color_bytes(self, index: int) -> bytes | None:
        """See ``OpenScan``; None for an image that is resampled."""
        lens = self.lens[index]
        if lens.size != self.image_size or needs_resampling(lens, self.pinhole):
            return None
        return self.images.encoded(index)

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        lens = self.lens[index]
        image = self.images.read(index, image_size or self.image_size, lens.size)
        return resample(image, lens, self.pinhole) if needs_resampling(lens, self.pinhole) else image

    def close(self) -> None:
        """Close the video, if it is one."""
        self.images.close()


def open_recording(recording: Recording) -> RecordedScan:
    """Return the scan of a recording whose images are files.

    Raises:
        DataError: see ``build_scan``.
    """

    def size_of(frame: Frame) -> tuple[int, int] | str:
        if not frame.image.is_file():
            return NO_IMAGE
        try:
            return stored_size([frame.image])
        except DataError:
            return UNREADABLE

    return build_scan(recording, size_of, lambda frames: ImageFiles(tuple(frame.image for frame in frames)))


def build_scan(
    recording: Recording,
    size_of: Callable[[Frame], tuple[int, int] | str],
    open_images: Callable[[list[Frame]], FrameImages],
) -> RecordedScan:
    """Return the scan of a recording.

    Frames without an image and those whose pose is no rigid motion are dropped. A lens for a larger or
    smaller size of the same image is scaled to the stored one.

    Args:
        recording: what a reader returned.
        size_of: ``(H, W)`` of a frame's image, or the reason for which the frame is dropped.
        open_images: gives the images of the usable frames.

    Raises:
        DataError: no frame is left, an image's aspect is not its lens's, or lenses are of different cameras.
    """
    frames, lenses, dropped = _usable(recording, size_of)
    if not frames:
        raise none_usable(recording.path, dropped)
    pinhole = shared_pinhole(lenses, recording.path)
    poses = np.array([frame.world_from_camera for frame in frames])
    return RecordedScan(
        scene_id=recording.scene_id,
        listed_in=recording.path,
        frame_id=tuple(frame.name for frame in frames),
        world_from_camera=torch.from_numpy(poses),
        intrinsics=pinhole.matrix,
        image_size=pinhole.size,
        axis_alignment=torch.eye(4, dtype=torch.float64),
        dropped={name: dropped[name] for name in sorted(dropped, key=numbers_first)},
        images=open_images(frames),
        lens=tuple(lenses),
        pinhole=pinhole,
    )


def _usable(
    recording: Recording, size_of: Callable[[Frame], tuple[int, int] | str]
) -> tuple[list[Frame], list[Lens], dict[str, str]]:
    """Return the usable frames in the order of their names, their lenses, and the reasons for the others."""
    dropped = dict(recording.dropped)
    frames: list[Frame] = []
    lenses: list[Lens] = []
    ordered = sorted(recording.frames, key=lambda frame: numbers_first(frame.name))
    faults = pose_faults(np.array([frame.world_from_camera for frame in ordered]).reshape(-1, 4, 4))
    for frame, fault in zip(ordered, faults, strict=True):
        size = size_of(frame) if fault is None else fault
        if isinstance(size, str):
            dropped[frame.name] = size
        else:
            frames.append(frame)
            lenses.append(_lens_for_size(frame, size, recording.path))
    return frames, lenses, dropped


def _lens_for_size(frame: Frame, size: tuple[int, int], listed_in: Path) -> Lens:
    """Return the frame's lens for the stored size ``(H, W)`` of its image."""
    height, width = frame.lens.size
    if abs((size[1] / size[0]) / (width / height) - 1) > _SAME_ASPECT:
        rotated = ", turned by 90°" if (size[1] > size[0]) != (width > height) else ""
        raise DataError(
            f"image {frame.name} is {size[1]}x{size[0]} and its intrinsics in {listed_in} are for "
            f"{width}x{height}{rotated}: give the images that the intrinsics were made for"
        )
    return check_lens(frame.lens.scaled_to(size), f"the camera of {frame.name} in {listed_in}")


def typed_lens(intrinsics: Intrinsics, size: tuple[int, int]) -> Lens:
    """Return the lens that a user typed for images of a stored size ``(H, W)``.

    Raises:
        DataError: no lens of such images has such intrinsics.
    """
    fx, fy, cx, cy = intrinsics
    return check_lens(Lens(size, (fx, fy), (cx, cy)), f"intrinsics={fx:g},{fy:g},{cx:g},{cy:g}")


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
