# SPDX-License-Identifier: Apache-2.0
"""A scan made of images, poses and lenses from any source."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.lens import Lens, check_lens, needs_resampling, resample, shared_pinhole
from raytran.capture.orient import Axes
from raytran.data.images import decode_image, stored_size
from raytran.data.scan import LOST, NO_IMAGE, NO_POSE, OpenScan, numbers_first
from raytran.data.scannet.text import are_rigid
from raytran.errors import DataError

UNREADABLE = "image cannot be read"
"""Reason for which a frame is dropped, beside those of ``raytran.data.scan``."""

IMAGE_ENDINGS = (".jpg", ".jpeg", ".png")

_SAME_ASPECT = 0.01


@dataclass(frozen=True)
class Shot:
    """One image with its pose and lens, as a source lists it.

    Attributes:
        name: what to call the frame.
        image: its file, or the video it is in.
        world_from_camera: ``(4, 4)`` float64, unit and axes of the source.
        lens: for the size that the source states.
        number: of the frame in a video.
    """

    name: str
    image: Path
    world_from_camera: NDArray[np.float64]
    lens: Lens
    number: int = 0


@dataclass(frozen=True, kw_only=True)
class Source:
    """What a reader found.

    Attributes:
        path: the file that lists the shots, to be named in messages.
        scene_id: what to call the scan.
        shots: at least one.
        axes: camera axes of the poses.
        up: direction of up in the world, ``(3,)``, if the format promises one.
        metric: whether the format promises metres.
        dropped: reason for each image or pose that is no shot.
    """

    path: Path
    scene_id: str
    shots: tuple[Shot, ...]
    axes: Axes = "opencv"
    up: tuple[float, float, float] | None = None
    metric: bool = False
    dropped: dict[str, str] = field(default_factory=dict)


class Pictures(ABC):
    """Images that can be read one by one."""

    @abstractmethod
    def read(
        self, index: int, image_size: tuple[int, int] | None, stored: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """Return ``(H, W, 3)`` RGB, resized to ``image_size`` if given.

        Raises:
            DataError: it is damaged or of another size than ``stored``.
        """

    def blob(self, index: int) -> bytes | None:
        """Return the JPEG or PNG as stored, or None if it is none.

        Raises:
            DataError: it cannot be read.
        """
        return None

    def close(self) -> None:
        """Close the file, if one is open."""
        return


@dataclass(frozen=True)
class ImageFiles(Pictures):
    """Images in files of their own."""

    paths: tuple[Path, ...]

    def read(
        self, index: int, image_size: tuple[int, int] | None, stored: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """See ``Pictures``."""
        path = self.paths[index]
        image = decode_image(path, name=str(path), image_size=image_size, stored=stored)
        return image.permute(1, 2, 0).numpy()

    def blob(self, index: int) -> bytes | None:
        """See ``Pictures``."""
        try:
            return self.paths[index].read_bytes()
        except OSError as error:
            raise DataError(
                f"cannot read the image {self.paths[index]} ({error.strerror}): copy or export it again"
            ) from error


@dataclass(frozen=True, kw_only=True)
class ImportedScan(OpenScan):
    """The usable frames of a source; those of a lens that distorts come resampled to a pinhole camera.

    Attributes:
        source: the file that lists them.
        pictures: their images.
        lens: of each, for the size of its image.
        pinhole: the camera that ``intrinsics`` describes.
    """

    source: Path
    pictures: Pictures
    lens: tuple[Lens, ...]
    pinhole: Lens

    @property
    def path(self) -> Path:
        """The file that lists the frames."""
        return self.source

    def color_bytes(self, index: int) -> bytes | None:
        """See ``OpenScan``; None for an image that is resampled."""
        as_stored = self.lens[index].size == self.image_size
        if as_stored and not needs_resampling(self.lens[index], self.pinhole):
            return self.pictures.blob(index)
        return None

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        lens = self.lens[index]
        image = self.pictures.read(index, image_size or self.image_size, lens.size)
        return resample(image, lens, self.pinhole) if needs_resampling(lens, self.pinhole) else image

    def close(self) -> None:
        """Close the video, if it is one."""
        self.pictures.close()


def from_files(source: Source) -> ImportedScan:
    """Return the scan of a source whose images are files; see ``assemble``.

    Raises:
        DataError: see ``assemble``.
    """

    def size_of(shot: Shot) -> tuple[int, int] | str:
        if not shot.image.is_file():
            return NO_IMAGE
        try:
            return stored_size([shot.image])
        except DataError:
            return UNREADABLE

    return assemble(source, size_of, lambda shots: ImageFiles(tuple(shot.image for shot in shots)))


def assemble(
    source: Source,
    size_of: Callable[[Shot], tuple[int, int] | str],
    open_pictures: Callable[[list[Shot]], Pictures],
) -> ImportedScan:
    """Return the scan of a source.

    Frames without an image and those whose pose is no rigid motion are dropped. A lens for a larger or
    smaller size of the same image is scaled to the stored one.

    Args:
        source: what a reader found.
        size_of: ``(H, W)`` of a shot's image, or the reason for which it is dropped.
        open_pictures: gives the images of shots.

    Raises:
        DataError: no frame is left, an image's aspect is not its lens's, or lenses are of different cameras.
    """
    shots, lenses, dropped = _usable(source, size_of)
    if not shots:
        reasons = ", ".join(f"{count} {reason}" for reason, count in Counter(dropped.values()).most_common())
        raise DataError(
            f"none of the {len(dropped)} frames of {source.path} has an image and a valid pose ({reasons}): "
            "check that its images lie beside it under the names it gives"
        )
    pinhole = shared_pinhole(lenses, source.path)
    poses = np.array([shot.world_from_camera for shot in shots])
    return ImportedScan(
        scene_id=source.scene_id,
        source=source.path,
        frame_id=tuple(shot.name for shot in shots),
        world_from_camera=torch.from_numpy(poses),
        intrinsics=pinhole.matrix,
        image_size=pinhole.size,
        axis_alignment=torch.eye(4, dtype=torch.float64),
        dropped={name: dropped[name] for name in sorted(dropped, key=numbers_first)},
        pictures=open_pictures(shots),
        lens=tuple(lenses),
        pinhole=pinhole,
    )


def frame_name(image: str) -> str:
    """Return the name of a frame from its image's path in a folder, without ``images/`` and ending.

    It may serve as a file name: folders are joined by an underscore.
    """
    return str(PurePosixPath(image).with_suffix("")).removeprefix("images/").replace("/", "_")


def images_in(folder: Path) -> list[Path]:
    """Return the JPEG and PNG files in a folder, in the order of the numbers in their names."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_ENDINGS]
    return sorted(found, key=lambda path: numbers_first(path.name))


def unposed_images(shots: Sequence[Shot], root: Path) -> dict[str, str]:
    """Return the images beside those of some shots that are no shot, with the reason.

    Args:
        shots: with images below ``root``.
        root: folder from which frames are named.
    """
    folders = {shot.image.parent for shot in shots}
    beside = {path for folder in folders if folder.is_dir() for path in images_in(folder)}
    names = (
        path.relative_to(os.path.abspath(root)).as_posix() for path in beside - {shot.image for shot in shots}
    )
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


def _usable(
    source: Source, size_of: Callable[[Shot], tuple[int, int] | str]
) -> tuple[list[Shot], list[Lens], dict[str, str]]:
    """Return the usable shots in the order of their names, their lenses, and the reasons for the others."""
    dropped = dict(source.dropped)
    shots: list[Shot] = []
    lenses: list[Lens] = []
    ordered = sorted(source.shots, key=lambda shot: numbers_first(shot.name))
    rigid = are_rigid(np.array([shot.world_from_camera for shot in ordered]).reshape(-1, 4, 4))
    for shot, good in zip(ordered, rigid.tolist(), strict=True):
        size = size_of(shot) if good else LOST
        if isinstance(size, str):
            dropped[shot.name] = size
        else:
            shots.append(shot)
            lenses.append(_fitted(shot, size, source.path))
    return shots, lenses, dropped


def _fitted(shot: Shot, size: tuple[int, int], listed_in: Path) -> Lens:
    """Return the shot's lens for the stored size of its image."""
    height, width = shot.lens.size
    if abs((size[1] / size[0]) / (width / height) - 1) > _SAME_ASPECT:
        turned = ", turned by 90°" if (size[1] > size[0]) != (width > height) else ""
        raise DataError(
            f"image {shot.name} is {size[1]}x{size[0]} and its intrinsics in {listed_in} are for "
            f"{width}x{height}{turned}: give the images that the intrinsics were made for"
        )
    return check_lens(shot.lens.scaled_to(size), f"the camera of {shot.name} in {listed_in}")
