# SPDX-License-Identifier: Apache-2.0
"""COLMAP models: ``cameras`` and ``images``, binary or text; their points and rigs are not needed.

Format: COLMAP's documentation, "Output Format". Poses there are camera-from-world in OpenCV axes, those of a
rig's cameras too; the world has neither a known up nor a known scale unless the model was aligned.

Files are walked here rather than by ``pycolmap.Reconstruction``: that accepts ``cameras.bin`` cut anywhere,
does not end on some cut ``images.bin``, and keeps every observation in memory. Lenses are pycolmap's.
"""

from __future__ import annotations

import codecs
import logging
import mmap
import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.lens import Lens, colmap_lens, lens_model
from raytran.capture.names import (
    IMAGE_FOLDERS,
    Located,
    frame_name,
    is_hidden,
    locate,
    unlike,
    unposed_images,
)
from raytran.capture.recording import (
    NO_ENTRY,
    NO_LENS,
    Frame,
    FrameList,
    Intrinsics,
    Recording,
    typed_lens,
)
from raytran.data.images import stored_size
from raytran.errors import DataError
from raytran.geometry.rotation import matrix_from_quaternion
from raytran.limits import FOCAL_LENGTH

_log = logging.getLogger(__name__)

_MODEL_PLACES = (
    (".", "models/*"),
    ("sparse", "sparse/*", "sparse/*/models/*"),
    ("colmap", "colmap/sparse", "colmap/sparse/*", "colmap/*"),
    ("dense/sparse", "dense/*/sparse", "dense/sparse/*"),
    ("0", "[0-9]*", "[0-9]*/sparse"),
)
"""Where programs put models below a folder: COLMAP, HLoc, nerfstudio, COLMAP's automatic reconstruction. The
largest of the first of these groups that has some is read."""

_PARTS_OF_PLACES = ("0", "sparse", "dense", "models", "colmap")
_MAX_NAME = 4096
_MAX_LINE = 1 << 24
"""Characters of a line of text that are looked at: observed points are not needed."""

_LARGEST_SIZE = 1 << 31
"""Larger sizes of images no camera has; those that are too large to be read are told so."""

_IMAGE_BYTES = 64
"""Bytes of an image in ``images.bin``, at least."""

_OF_WINDOWS = "cp1252"
_WIDE_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_POINT_BYTES = 24
"""Bytes of an observed point in ``images.bin``."""


@dataclass(frozen=True)
class _Image:
    """A registered image.

    Attributes:
        name: path below the folder of images.
        camera: number of its camera.
        quaternion: (w, x, y, z) of camera-from-world.
        translation: of camera-from-world.
    """

    name: str
    camera: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]


def find_model(path: Path) -> Path | None:
    """Return the folder of the COLMAP model in or below a folder, or None if there is none.

    Of several the one with the most images is taken.
    """
    if not path.is_dir():
        return None
    for places in _MODEL_PLACES:
        folders = [
            folder
            for place in places
            for folder in (sorted(path.glob(place)) if "*" in place else [path / place])
            if not any(map(is_hidden, folder.relative_to(path).parts)) and _file_ending(folder) is not None
        ]
        if len(folders) > 1:
            return max(folders, key=_num_images)
        if folders:
            return folders[0]
    return None


def read_colmap(path: Path, intrinsics: Intrinsics | None = None) -> Recording:
    """Read a COLMAP model.

    Args:
        path: the folder of the model, or one that holds it in ``sparse/0`` beside ``images``.
        intrinsics: of the stored images, in place of the model's.

    Raises:
        ConfigError: a lens distorts and pycolmap is not installed.
        DataError: there is no model, it is damaged, or it has no images.
    """
    model = find_model(path)
    ending = None if model is None else _file_ending(model)
    if model is None or ending is None:
        raise DataError(
            f"{path} holds no COLMAP model: wanted are cameras and images, both .bin or both .txt, there or "
            "in sparse/0"
        )
    listed = model / f"images{ending}"
    collected = FrameList()
    if ending == ".bin":
        cameras, images = _cameras_binary(model / "cameras.bin"), _images_binary(listed)
    else:
        cameras, images = _cameras_text(model / "cameras.txt"), _images_text(listed, collected)
    if not images:
        collected.checked()
        raise DataError(f"{listed} holds no images: COLMAP registered none, so map again with more overlap")
    folder, located = _located(path, model, [image.name for image in images])
    located.report(listed, folder)
    if intrinsics is not None:
        found = [place for place in located.places if isinstance(place, Path)]
        typed = typed_lens(intrinsics, stored_size(found or [listed]))
    names = unlike([_frame_name(place, image.name, folder) for image, place in _pairs(images, located)])
    for name, (image, place), pose in zip(
        names, _pairs(images, located), _world_from_camera(images), strict=True
    ):
        if isinstance(place, str):
            collected.dropped[name] = place
            continue
        with collected.sparing(name, NO_LENS):
            lens = typed if intrinsics is not None else _lens(cameras, image, listed)
            collected.frames.append(Frame(name, place, pose, lens))
    placed = [place for place in located.places if isinstance(place, Path)]
    collected.dropped |= unposed_images(placed, folder, [*names, *collected.dropped])
    return Recording(
        path=listed,
        scene_id=_scene_name(path),
        frames=collected.checked(),
        dropped=collected.dropped,
    )


def _pairs(images: Sequence[_Image], located: Located) -> Iterator[tuple[_Image, Path | str]]:
    return zip(images, located.places, strict=True)


def _frame_name(place: Path | str, listed: str, folder: Path) -> str:
    """Return the name of a frame from where its image lies, or else from what the list calls it."""
    if isinstance(place, Path):
        return frame_name(place.relative_to(folder).as_posix())
    return frame_name(listed.replace("\\", "/"))


def _lens(cameras: dict[int, Lens | DataError], image: _Image, listed: Path) -> Lens:
    """Return the lens of an image's camera.

    Raises:
        DataError: there is no such camera, or it is no lens.
    """
    lens = cameras.get(image.camera)
    if isinstance(lens, Lens):
        return lens
    raise lens or DataError(
        f"{listed} gives {image.name[-100:]} camera {image.camera}, which cameras{listed.suffix} "
        "does not have: export the model again"
    )


def _scene_name(path: Path) -> str:
    """Return the name of the first folder that is not one that programs put models in."""
    folders = (path.resolve(), *path.resolve().parents)
    return next(
        (f.name for f in folders if f.name not in _PARTS_OF_PLACES and not f.name.isdecimal()), "scene"
    )


def _file_ending(folder: Path) -> str | None:
    """Return the ending of a model's files, or None if a folder holds none."""
    for ending in (".bin", ".txt"):
        if (folder / f"cameras{ending}").is_file() and (folder / f"images{ending}").is_file():
            return ending
    return None


def _num_images(folder: Path) -> int:
    """Return how many images a model has, at most as many as the size of its list allows."""
    ending = _file_ending(folder)
    listed = folder / f"images{ending}"
    if ending == ".txt":
        return sum(_as_image(line) is not None for _, line in _lines(listed))
    try:
        with listed.open("rb") as file:
            (count,) = struct.unpack("<Q", file.read(8))
        return min(int(count), listed.stat().st_size // _IMAGE_BYTES)
    except (OSError, struct.error):
        return 0


def _located(path: Path, model: Path, names: list[str]) -> tuple[Path, Located]:
    """Return the folder of a model's images, or where they belong; and where in it each image is.

    The folders nearest to the model come first. An undistorted model, below ``dense``, has images of its own:
    those of the same names above it were not undistorted.
    """
    scene = Path(os.path.abspath(path))
    bases = [Path(os.path.abspath(model))]
    while bases[-1].name != "dense" and len(bases) < 5:
        bases.append(bases[-1].parent)
    folders = [base / name for base in bases for name in (*IMAGE_FOLDERS, ".") if (base / name).is_dir()]
    tried = names[:: max(1, len(names) // 8)]
    for folder in folders:
        if any(os.path.isfile(folder / name) for name in tried if ".." not in name):
            return folder, locate(names, folder)
    candidates = [
        (folder, locate(names, folder))
        for folder in folders
        if folder.name in IMAGE_FOLDERS or scene in (folder, *folder.parents)
    ]
    found = max(candidates, key=lambda candidate: candidate[1].num_found, default=None)
    if found is not None and found[1].num_found:
        return found
    return scene / "images", locate(names, scene / "images")


def _world_from_camera(images: list[_Image]) -> NDArray[np.float64]:
    """Return the inverted poses of images, ``(n, 4, 4)``."""
    rotation = matrix_from_quaternion(torch.tensor([i.quaternion for i in images], dtype=torch.float64))
    translation = torch.tensor([i.translation for i in images], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(images), 1, 1)
    poses[:, :3, :3] = rotation.mT
    poses[:, :3, 3] = -(rotation.mT @ translation[..., None])[..., 0]
    return poses.numpy()


def _cameras_text(path: Path) -> dict[int, Lens | DataError]:
    """Return the lens of each camera, or what is wrong with it."""
    cameras: dict[int, Lens | DataError] = {}
    broken: DataError | None = None
    for row, line in _lines(path):
        if not line.strip():
            continue
        try:
            number, model, width, height, *params = line.split()
            camera = int(number)
            size = (int(height), int(width))
            values = [float(value) for value in params]
            if max(size) > _LARGEST_SIZE:
                raise ValueError("its size is none")
        except ValueError as error:
            broken = broken or DataError(
                f"line {row} of {path} is no camera ({str(error)[:80]}): export the model again"
            )
            continue
        cameras[camera] = _lens_or_fault(model, size, values, f"camera {camera} in {path}")
    if broken is not None and not any(isinstance(lens, Lens) for lens in cameras.values()):
        raise broken
    return cameras


def _lens_or_fault(
    model: str | int, size: tuple[int, int], params: Sequence[float], where: str
) -> Lens | DataError:
    """Return the lens of a camera, or what is wrong with it."""
    if not all(abs(value) <= FOCAL_LENGTH.high for value in params):  # not-a-number is not
        return DataError(f"{where} has parameters that no lens has: export the model again")
    try:
        return colmap_lens(model, size, params, where)
    except DataError as error:
        return error


def _images_text(path: Path, collected: FrameList) -> list[_Image]:
    """Return the images of a text model; a damaged line is put down as a frame that is left out.

    Each image has a second line, of its observed points, which may be empty. Editors and scripts strip empty
    lines, so a line that is an image is read as one wherever it stands.
    """
    images: list[_Image] = []
    is_points, num_missing = False, 0
    for row, line in _lines(path):
        image = _as_image(line)
        if is_points and (image is None or _is_numeric(image.name)):
            is_points = False
            continue
        num_missing += is_points
        if image is not None:
            images.append(image)
        elif line.strip():
            with collected.sparing(f"line {row}", NO_ENTRY):
                raise DataError(f"line {row} of {path} is no image: export the model again")
        is_points = bool(line.strip())
    if num_missing:
        _log.info("%s: %d images have no line of points after them", path, num_missing)
    return images


def _as_image(line: str) -> _Image | None:
    """Return the image that a line of ``images.txt`` describes, or None if it is none."""
    words = line.split(maxsplit=9)
    if len(words) < 10 or len(words[9]) > _MAX_NAME:
        return None
    try:
        int(words[0])
        values = [float(word) for word in words[1:8]]
        return _Image(words[9].strip(), int(words[8]), tuple(values[:4]), tuple(values[4:]))
    except ValueError:
        return None


def _is_numeric(text: str) -> bool:
    """Whether all words are numbers, as in a line of points."""
    try:
        return [float(word) for word in text.split()] != []
    except ValueError:
        return False


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines that are no comments, empty ones among them, and their numbers."""
    try:
        with path.open("rb") as file:
            encoding = "utf-16" if file.read(2) in _WIDE_MARKS else "utf-8-sig"
            file.seek(0)
            encoding = encoding if encoding == "utf-16" or _is_utf8(file) else _OF_WINDOWS
        with path.open(encoding=encoding) as text:
            row = 1
            while line := text.readline(_MAX_LINE):
                rest = line
                while rest and not rest.endswith("\n"):
                    rest = text.readline(_MAX_LINE)
                if not line.startswith("#"):
                    yield row, line
                row += 1
    except (OSError, UnicodeError) as error:
        raise DataError(f"cannot read {path} ({str(error)[:80]}): export the model again") from error


def _is_utf8(file: BinaryIO) -> bool:
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        while chunk := file.read(_MAX_LINE):
            decoder.decode(chunk)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return False
    return True


def _decoded(name: bytes) -> str:
    """Return the name of an image, in UTF-8 or as Windows spells it."""
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode(_OF_WINDOWS, errors="replace")


def _cameras_binary(path: Path) -> dict[int, Lens | DataError]:
    cameras: dict[int, Lens | DataError] = {}
    with _mapped(path) as data:
        (count,) = struct.unpack_from("<Q", data, 0)
        at = 8
        for _ in range(count):
            number, model, width, height = struct.unpack_from("<IiQQ", data, at)
            where = f"camera {number} in {path}"
            layout = f"<{lens_model(model, where).num_params}d"
            params = struct.unpack_from(layout, data, at + 24)
            cameras[number] = _lens_or_fault(model, (height, width), params, where)
            at += 24 + struct.calcsize(layout)
    return cameras


def _images_binary(path: Path) -> list[_Image]:
    images = []
    with _mapped(path) as data:
        (count,) = struct.unpack_from("<Q", data, 0)
        at = 8
        # A count that is too large ends at the first record that is not there.
        for _ in range(count):
            _, *pose, camera = struct.unpack_from("<I7dI", data, at)
            start = at + struct.calcsize("<I7dI")
            end = data.find(b"\0", start, start + _MAX_NAME)
            if end < 0:
                raise struct.error("no end of a name")
            (num_points,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + num_points * _POINT_BYTES
            if at > len(data):
                raise struct.error("too few points")
            name = _decoded(data[start:end])
            images.append(_Image(name, camera, tuple(pose[:4]), tuple(pose[4:])))
    return images


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    """Map a binary file into memory; reading past its end is a DataError."""
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            yield data
    except OSError as error:
        raise DataError(f"cannot read {path} ({error.strerror}): check the path") from error
    except (struct.error, ValueError) as error:  # ValueError: an empty file cannot be mapped.
        raise DataError(f"{path} ends early or is damaged: export the model again") from error
