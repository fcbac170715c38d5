# SPDX-License-Identifier: Apache-2.0
"""COLMAP models: ``cameras`` and ``images``, binary or text; their points and rigs are not needed.

Format: COLMAP's documentation, "Output Format". Poses there are camera-from-world in OpenCV axes, those of a
rig's cameras too; the world has neither a known up nor a known scale unless the model was aligned.

Files are walked here rather than by ``pycolmap.Reconstruction``: that accepts ``cameras.bin`` cut anywhere,
does not end on some cut ``images.bin``, and keeps every observation in memory. Lenses are pycolmap's.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.lens import Lens, colmap_lens, lens_model
from raytran.capture.recording import Frame, Recording, frame_name, path_inside, unposed_images
from raytran.errors import DataError
from raytran.geometry.rotation import matrix_from_quaternion

_MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "dense/sparse", "0")
_IMAGE_FOLDERS = ("images", "input", "rgb", "color", ".")
_MAX_NAME = 4096
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

    Of several in ``sparse`` the one with the largest list of images is taken.
    """
    for name in _MODEL_FOLDERS:
        folder = path / name
        if _file_ending(folder) is not None:
            siblings = [other for other in folder.parent.iterdir() if _file_ending(other) is not None]
            return max(siblings, key=_bytes_of_images) if folder.name == "0" else folder
    return None


def read_colmap(path: Path) -> Recording:
    """Read a COLMAP model.

    Args:
        path: the folder of the model, or one that holds it in ``sparse/0`` beside ``images``.

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
    if ending == ".bin":
        lenses, images = _cameras_binary(model / "cameras.bin"), _images_binary(model / "images.bin")
    else:
        lenses, images = _cameras_text(model / "cameras.txt"), _images_text(model / "images.txt")
    listed = model / f"images{ending}"
    if not images:
        raise DataError(f"{listed} holds no images: COLMAP registered none, so map again with more overlap")
    without_camera = next((image for image in images if image.camera not in lenses), None)
    if without_camera is not None:
        raise DataError(
            f"{listed} gives {without_camera.name} camera {without_camera.camera}, which cameras{ending} "
            "does not have: export the model again"
        )
    folder = _image_folder(path, model, [image.name for image in images])
    frames = tuple(
        Frame(frame_name(image.name), path_inside(folder, image.name, listed), pose, lenses[image.camera])
        for image, pose in zip(images, _world_from_camera(images), strict=True)
    )
    ancestors = (path.resolve(), *path.resolve().parents)
    scene = next(folder for folder in ancestors if folder.name not in ("0", "sparse"))
    return Recording(path=listed, scene_id=scene.name, frames=frames, dropped=unposed_images(frames, folder))


def _file_ending(folder: Path) -> str | None:
    """Return the ending of a model's files, or None if a folder holds none."""
    for ending in (".bin", ".txt"):
        if (folder / f"cameras{ending}").is_file() and (folder / f"images{ending}").is_file():
            return ending
    return None


def _bytes_of_images(folder: Path) -> int:
    return (folder / f"images{_file_ending(folder)}").stat().st_size


def _image_folder(path: Path, model: Path, names: list[str]) -> Path:
    """Return the first folder that has one of a model's images; or where they belong."""
    tried = names[:: max(1, len(names) // 8)]
    bases = dict.fromkeys((path, *[model, *model.parents][:4]))
    for base in bases:
        for name in _IMAGE_FOLDERS:
            if any((base / name / image).is_file() for image in tried if ".." not in image):
                return base / name
    return path / "images"


def _world_from_camera(images: list[_Image]) -> NDArray[np.float64]:
    """Return the inverted poses of images, ``(n, 4, 4)``."""
    rotation = matrix_from_quaternion(torch.tensor([i.quaternion for i in images], dtype=torch.float64))
    translation = torch.tensor([i.translation for i in images], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(images), 1, 1)
    poses[:, :3, :3] = rotation.mT
    poses[:, :3, 3] = -(rotation.mT @ translation[..., None])[..., 0]
    return poses.numpy()


def _cameras_text(path: Path) -> dict[int, Lens]:
    lenses = {}
    for row, line in _lines(path):
        if not line.strip():
            continue
        try:
            number, model, width, height, *params = line.split()
            camera = int(number)
            size = (int(height), int(width))
            values = [float(value) for value in params]
        except ValueError as error:
            raise DataError(f"line {row} of {path} is no camera ({error}): export the model again") from error
        lenses[camera] = colmap_lens(model, size, values, f"camera {camera} in {path}")
    return lenses


def _images_text(path: Path) -> list[_Image]:
    images = []
    # Each image has a second line, of its observed points, which may be empty.
    is_points = False
    for row, line in _lines(path):
        words = line.split(maxsplit=9)
        if is_points or not words:
            is_points = False
            continue
        try:
            values = [float(word) for word in words[1:8]]
            images.append(_Image(words[9].strip(), int(words[8]), tuple(values[:4]), tuple(values[4:])))
        except (ValueError, IndexError) as error:
            raise DataError(f"line {row} of {path} is no image ({error}): export the model again") from error
        is_points = True
    return images


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines that are no comments, empty ones among them, and their numbers."""
    try:
        with path.open(encoding="utf-8") as file:
            for row, line in enumerate(file, start=1):
                if not line.startswith("#"):
                    yield row, line
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read {path} ({error}): export the model again") from error


def _cameras_binary(path: Path) -> dict[int, Lens]:
    lenses = {}
    with _mapped(path) as data:
        (count,) = struct.unpack_from("<Q", data, 0)
        at = 8
        for _ in range(count):
            number, model, width, height = struct.unpack_from("<IiQQ", data, at)
            where = f"camera {number} in {path}"
            layout = f"<{lens_model(model, where).num_params}d"
            params = struct.unpack_from(layout, data, at + 24)
            lenses[number] = colmap_lens(model, (height, width), params, where)
            at += 24 + struct.calcsize(layout)
    return lenses


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
            name = data[start:end].decode("utf-8", errors="replace")
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
