# SPDX-License-Identifier: Apache-2.0
"""COLMAP models: ``cameras`` and ``images``, binary or text, without their points.

Format: COLMAP's documentation, "Output Format". Poses there are camera-from-world in OpenCV axes; the
world has neither a known up nor a known scale unless the model was aligned.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.imported import Shot, Source, frame_name, path_inside, unposed_images
from raytran.capture.lens import Lens, check_lens
from raytran.errors import DataError
from raytran.geometry.rotation import matrix_from_quaternion

_PERSPECTIVE = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""Model → its parameters."""

_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
)
"""Name and number of parameters by the number of a model in binary files; newer ones are refused unread."""

_MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "dense/sparse", "0")
_IMAGE_FOLDERS = ("images", "input", "rgb", "color", ".")
_MAX_NAME = 4096
_POINT_BYTES = 24


@dataclass(frozen=True)
class _Image:
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
        if _listing(folder) is not None:
            parts = [other for other in folder.parent.iterdir() if _listing(other) is not None]
            return max(parts, key=_bytes_of_images) if folder.name == "0" else folder
    return None


def read_colmap(path: Path) -> Source:
    """Read a COLMAP model.

    Args:
        path: the folder of the model, or one that holds it in ``sparse/0`` beside ``images``.

    Raises:
        DataError: there is no model, it is damaged, its lenses are fisheyes, or it has no images.
    """
    model = find_model(path)
    ending = None if model is None else _listing(model)
    if model is None or ending is None:
        raise DataError(
            f"{path} holds no COLMAP model: wanted are cameras and images, both .bin or both .txt, there or "
            "in sparse/0"
        )
    binary = ending == ".bin"
    lenses = dict(_cameras_binary(model) if binary else _cameras_text(model))
    images = list(_images_binary(model) if binary else _images_text(model))
    listed = model / f"images{ending}"
    if not images:
        raise DataError(f"{listed} holds no images: COLMAP registered none, so map again with more overlap")
    unknown = next((image for image in images if image.camera not in lenses), None)
    if unknown is not None:
        raise DataError(
            f"{listed} gives {unknown.name} camera {unknown.camera}, which cameras{ending} does not have: "
            "export the model again"
        )
    folder = _image_folder(path, model, [image.name for image in images])
    poses = _world_from_camera(images)
    shots = tuple(
        Shot(frame_name(image.name), path_inside(folder, image.name, listed), pose, lenses[image.camera])
        for image, pose in zip(images, poses, strict=True)
    )
    dropped = unposed_images(shots, folder)
    scene_id = next(
        part for part in (path.resolve(), *path.resolve().parents) if part.name not in ("0", "sparse")
    )
    return Source(path=listed, scene_id=scene_id.name, shots=shots, dropped=dropped)


def _listing(folder: Path) -> str | None:
    """Return the ending of a model's files, or None if a folder holds none."""
    for ending in (".bin", ".txt"):
        if (folder / f"cameras{ending}").is_file() and (folder / f"images{ending}").is_file():
            return ending
    return None


def _bytes_of_images(folder: Path) -> int:
    return (folder / f"images{_listing(folder)}").stat().st_size


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
    turn = matrix_from_quaternion(torch.tensor([i.quaternion for i in images], dtype=torch.float64))
    shift = torch.tensor([i.translation for i in images], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(images), 1, 1)
    poses[:, :3, :3] = turn.mT
    poses[:, :3, 3] = -(turn.mT @ shift[..., None])[..., 0]
    return poses.numpy()


def _lens(model: str, size: tuple[int, int], values: list[float], where: str) -> Lens:
    names = _PERSPECTIVE.get(model, "").split()
    if not names:
        raise DataError(
            f"{where} has the lens model {model}, a fisheye or another that is not read: undistort the "
            "images with COLMAP's image_undistorter and give the folder that it writes"
        )
    if len(values) != len(names):
        raise DataError(
            f"{where} has {len(values)} parameters for {model}, not {len(names)}: export it again"
        )
    value = dict(zip(names, values, strict=True))
    fx, fy = value.get("fx", value.get("f", 0.0)), value.get("fy", value.get("f", 0.0))
    lens = Lens(
        size,
        (fx, fy),
        (value["cx"], value["cy"]),
        radial=tuple(value.get(key, 0.0) for key in ("k1", "k2", "k3")),
        divisor=tuple(value.get(key, 0.0) for key in ("k4", "k5", "k6")),
        tangential=(value.get("p1", 0.0), value.get("p2", 0.0)),
    )
    return check_lens(lens, where)


def _cameras_text(folder: Path) -> Iterator[tuple[int, Lens]]:
    path = folder / "cameras.txt"
    for row, line in _lines(path):
        if not line.strip():
            continue
        try:
            number, model, width, height, *values = line.split()
            camera = int(number), model, (int(height), int(width)), [float(value) for value in values]
        except ValueError as error:
            raise DataError(f"line {row} of {path} is no camera ({error}): export the model again") from error
        yield camera[0], _lens(*camera[1:], f"camera {camera[0]} in {path}")


def _images_text(folder: Path) -> Iterator[_Image]:
    path = folder / "images.txt"
    points_follow = False
    for row, line in _lines(path):
        if points_follow:
            points_follow = False
            continue
        words = line.split(maxsplit=9)
        if not words:
            continue
        try:
            values = [float(word) for word in words[1:8]]
            yield _Image(words[9].strip(), int(words[8]), tuple(values[:4]), tuple(values[4:]))
        except (ValueError, IndexError) as error:
            raise DataError(f"line {row} of {path} is no image ({error}): export the model again") from error
        points_follow = True


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines that are no comments, empty ones among them, and their numbers."""
    try:
        with path.open(encoding="utf-8") as file:
            for row, line in enumerate(file, start=1):
                if not line.startswith("#"):
                    yield row, line
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read {path} ({error}): export the model again") from error


def _cameras_binary(folder: Path) -> Iterator[tuple[int, Lens]]:
    path = folder / "cameras.bin"
    with _Binary(path) as file:
        for _ in range(file.unpack("<Q")[0]):
            number, model, width, height = file.unpack("<IiQQ")
            where = f"camera {number} in {path}"
            if not 0 <= model < len(_MODELS):
                _lens(f"number {model}", (1, 1), [], where)
            name, count = _MODELS[model]
            yield number, _lens(name, (height, width), list(file.unpack(f"<{count}d")), where)


def _images_binary(folder: Path) -> Iterator[_Image]:
    with _Binary(folder / "images.bin") as file:
        for _ in range(file.unpack("<Q")[0]):
            _, *values, camera = file.unpack("<I7dI")
            name = file.text()
            file.skip(file.unpack("<Q")[0] * _POINT_BYTES)
            yield _Image(name, camera, tuple(values[:4]), tuple(values[4:]))


class _Binary:
    """A binary file that is read forwards; reading past its end is a DataError."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._size = path.stat().st_size
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise DataError(f"cannot read {path} ({error.strerror}): check the path") from error

    def __enter__(self) -> _Binary:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def unpack(self, layout: str) -> tuple:
        raw = self._file.read(struct.calcsize(layout))
        if len(raw) < struct.calcsize(layout):
            raise self._cut()
        return struct.unpack(layout, raw)

    def text(self) -> str:
        """Return the bytes up to the next zero."""
        raw = bytearray()
        while (byte := self._file.read(1)) != b"\0":
            if not byte or len(raw) == _MAX_NAME:
                raise self._cut()
            raw += byte
        return raw.decode("utf-8", errors="replace")

    def skip(self, count: int) -> None:
        if self._file.tell() + count > self._size:
            raise self._cut()
        self._file.seek(count, 1)

    def _cut(self) -> DataError:
        return DataError(f"{self._path} ends early or is damaged: export the model again")
