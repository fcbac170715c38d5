# SPDX-License-Identifier: Apache-2.0
"""A recording: frames with poses and lenses as a reader of some format returns them, and the scan they make.

The helpers at the end, for names, image folders and JSON files, trust nothing that a file says.
"""

from __future__ import annotations

import json
import math
import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.lens import Lens, check_lens, needs_resampling, resample, shared_pinhole
from raytran.data.images import (
    IMAGE_ENDINGS,
    ImageHeader,
    OrientationTags,
    decode_image,
    kept_bytes,
    read_header,
    white_level,
)
from raytran.data.scan import LOST, NO_IMAGE, NO_POSE, OpenScan, numbers_first
from raytran.data.scannet.text import are_rigid
from raytran.errors import DataError

Axes = Literal["opencv", "opengl"]
"""Axes of a camera: x right, y down, z forward; or x right, y up, z backward."""

UNREADABLE = "image cannot be read"
"""Reason for which a frame is dropped, beside those of ``raytran.data.scan``."""

_SAME_ASPECT = 0.01
_MAX_JSON_BYTES = 64 * 2**20


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
    turns: dict[Path, tuple[int, bool]] = {}

    def size_of(frame: Frame) -> tuple[int, int] | str:
        if not frame.image.is_file():
            return NO_IMAGE
        try:
            header = read_header(frame.image)
        except DataError:
            return UNREADABLE
        is_turned = is_for_shown(frame.lens.size, header, default=recording.honours_exif)
        turns[frame.image] = header.orientation, is_turned
        return header.shown_size if is_turned else header.size

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
        abs((of_image[1] / of_image[0]) / (size[1] / size[0]) - 1) <= _SAME_ASPECT
        for of_image in (header.shown_size, header.size)
    )
    return header.orientation != 1 and (default if fits_shown == fits_stored else fits_shown)


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
        reasons = ", ".join(f"{count} {reason}" for reason, count in Counter(dropped.values()).most_common())
        raise DataError(
            f"none of the {len(dropped)} frames of {recording.path} has an image and a valid pose "
            f"({reasons}): check that its images lie beside it under the names it gives"
        )
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
    rigid = are_rigid(np.array([frame.world_from_camera for frame in ordered]).reshape(-1, 4, 4))
    for frame, is_rigid in zip(ordered, rigid.tolist(), strict=True):
        size = size_of(frame) if is_rigid else LOST
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


def frame_name(image: str) -> str:
    """Return the name of a frame from its image's path in a folder, without ``images/`` and ending.

    Folders are joined by an underscore, so that it may serve as a file name.
    """
    return str(PurePosixPath(image).with_suffix("")).removeprefix("images/").replace("/", "_")


def images_in(folder: Path) -> list[Path]:
    """Return the images in a folder, in the order of the numbers in their names."""
    images = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_ENDINGS]
    return sorted(images, key=lambda path: numbers_first(path.name))


def unposed_images(frames: Sequence[Frame], root: Path) -> dict[str, str]:
    """Return the images in the folders of some frames that belong to none of them, with the reason.

    Args:
        frames: with images below ``root``.
        root: folder from which frames are named.
    """
    folders = {frame.image.parent for frame in frames}
    images = {path for folder in folders if folder.is_dir() for path in images_in(folder)}
    without_pose = images - {frame.image for frame in frames}
    names = (path.relative_to(os.path.abspath(root)).as_posix() for path in without_pose)
    return {frame_name(name): NO_POSE for name in names}


def path_inside(folder: Path, name: str, listed_in: Path) -> Path:
    """Return the path of a file that a list names.

    Raises:
        DataError: the name leads out of the folder; a list from a stranger must not have files read that
            lie elsewhere.
    """
    root = os.path.abspath(folder)
    path = os.path.abspath(os.path.join(root, name)) if "\0" not in name else ""
    if not path.startswith(root + os.sep):
        raise DataError(
            f"{listed_in} names the image {name[:200]!r}, which is outside {folder}: "
            "move the images there and write relative paths"
        )
    return Path(path)


def read_json(path: Path) -> dict[str, Any]:
    """Return the object that a JSON file holds.

    Raises:
        DataError: the file cannot be read, is larger than 64 MB, or holds no JSON object.
    """
    try:
        if path.stat().st_size > _MAX_JSON_BYTES:
            raise DataError(f"{path} is larger than 64 MB, as no list of frames is: check the path")
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise DataError(f"cannot read {path} ({error.strerror}): check the path") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is no valid JSON ({error}): export it again") from error
    if not isinstance(content, dict):
        raise DataError(f"{path} holds a {type(content).__name__}, not a JSON object: export it again")
    return content


def number(content: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return the finite number at a key of a JSON object.

    Args:
        content: the object.
        key: name of the value.
        where: name of the object in messages.
        default: value if the key is missing; None: it must be there.

    Raises:
        DataError: it is missing or no finite number.
    """
    value = content.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        state = f"has {key} = {str(value)[:50]!r}" if key in content else f"has no {key}"
        raise DataError(f"{where} {state} where a number is needed: export it again")
    return float(value)


def numbers(content: Mapping[str, Any], key: str, where: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the array at a key of a JSON object; it may hold numbers that are not finite.

    Args:
        content: the object.
        key: name of the value.
        where: name of the object in messages.
        shape: of the array; a flat list of as many numbers will do.

    Raises:
        DataError: it is missing or of another size.
    """
    try:
        return np.array(content[key], dtype=np.float64).reshape(shape)
    except (KeyError, TypeError, ValueError) as error:
        size = "x".join(map(str, shape))
        raise DataError(f"{where} has no {key} of {size} numbers: export it again") from error
