# SPDX-License-Identifier: Apache-2.0
"""The files of a CAD model: its mesh (OBJ), the colours of its faces (MTL) and its voxels (binvox).

These are our own readers, because ShapeNet's boxes and origins count the vertices of a file as they are, and
because a file may come from anywhere: every reader limits the memory that a file can claim. trimesh splits
vertices where normals or textures differ, groups faces by material, counts negative indices from the end of
the file, reads a damaged OBJ as an empty mesh, opens every texture that an MTL names, and takes a missing
scale of voxels as 1.
"""

from __future__ import annotations

import logging
import re
from array import array
from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from raytran.data.images import UNREADABLE, open_image
from raytran.errors import ConfigError, DataError
from raytran.limits import COORDINATE, VOXEL_CUBE, as_number, as_numbers, shown

_log = logging.getLogger(__name__)

MAX_VERTICES = 10_000_000
"""Most vertices, and most triangles, of a model that is read."""

_MAX_LINE_BYTES = 1 << 20
"""Longest line that is read, bytes."""

# What the converter of ShapeNetCore v2 (assimp) says of its own file. It counts lines and points as faces.
_ANNOUNCED = re.compile(rb"# (?:Mesh '.*' with )?(\d+) (vertex positions|faces)\s*$")

_DIGITS = 12
"""Digits of an announced number that count: none is as large."""

_GREY = (0.7, 0.7, 0.7)
"""Colour of what has none that can be read."""

_MAX_TEXTURE_PIXELS = 64 * 10**6
_MAX_COLORS = 256
"""Most colours of a model; one with more is grey."""

_MAX_MTL_BYTES = 4 * 2**20
"""Bytes of the largest material file that is read; ShapeNet's have some kilobytes."""

_MAX_CELLS_A_SIDE = 512
"""Most cells along a side that are read; ShapeNet has 128."""

_MAX_VOXEL_BYTES = 64 * 2**20
"""Largest file that is read; ShapeNet's have less than one megabyte."""


def read_obj(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read positions and faces of an OBJ file into one mesh of triangles.

    Polygons are cut into fans. Negative numbers count back from the newest vertex. Groups, materials, lines,
    points and faces of two corners (edges, in ShapeNetCore v1) are left out.

    Returns:
        all vertices ``(V, 3)`` in the order of the file, also those that no face uses, and the vertex
        numbers of the triangles ``(F, 3)``.

    Raises:
        DataError: the file is missing, has no faces or too many, ends early, or holds something that is no
            number, no finite position or no vertex of it.
    """
    vertices, corners = array("d"), array("q")
    try:
        announced = _parse(path, vertices, corners)
    except OSError as error:
        raise DataError(f"cannot read the CAD model {path}: {error.strerror}; restore the file") from error
    except (ValueError, OverflowError) as error:
        raise DataError(f"the CAD model {path} is damaged: {str(error)[:80]}; restore the file") from error
    if announced:
        raise DataError(f"the CAD model {path} ends early: {announced}; restore the file")
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(corners, dtype=np.int64).reshape(-1, 3)
    if not len(faces) or faces.min() < 0 or faces.max() >= len(points):
        raise DataError(f"the CAD model {path} has no faces or misses vertices; restore the file")
    if not (np.abs(points) <= COORDINATE.high).all():
        raise DataError(
            f"the CAD model {path} has vertices that are not finite, or far off; restore the file"
        )
    return points, faces


def replaced_obj(path: Path, vertices: NDArray[np.float64], rotation: NDArray[np.float64]) -> Iterator[bytes]:
    """Yield the lines of an OBJ file with other positions; all but them and normals stays as it is.

    Args:
        path: a file that ``read_obj`` accepts.
        vertices: ``(V, 3)`` positions in the order of the file.
        rotation: ``(3, 3)``, applied to the normals.
    """
    position = iter(vertices.tolist())
    for line in _lines(path):
        words = line.split()
        if words[:1] == [b"v"]:
            yield "v {:.7f} {:.7f} {:.7f}\n".format(*next(position)).encode("ascii")
        elif words[:1] == [b"vn"]:
            normal = rotation @ np.array(words[1:4], dtype=np.float64)
            yield "vn {:.4f} {:.4f} {:.4f}\n".format(*normal.tolist()).encode("ascii")
        else:
            yield line.rstrip(b"\r\n") + b"\n"


def _parse(path: Path, vertices: array[float], corners: array[int]) -> str:
    """Read an OBJ file into flat lists of coordinates and of the triangles' vertex numbers.

    Returns:
        what the file's comments announce but the file lacks, as words; empty if nothing is missing.
    """
    expected = {b"vertex positions": 0, b"faces": 0}
    elements = 0
    for line in _lines(path):
        words = line.split()
        kind = words[0] if words else b""
        if kind == b"v":
            x, y, z = words[1:4]
            vertices.extend((float(x), float(y), float(z)))
        elif kind == b"f":
            elements += 1
            count = len(vertices) // 3
            # Of "vertex/texture/normal" only the vertex counts.
            numbers = [int(word.partition(b"/")[0]) for word in words[1:]]
            first, *rest = [number - 1 if number > 0 else count + number for number in numbers]
            # A polygon is cut into a fan of triangles around its first corner.
            for second, third in pairwise(rest):
                corners.extend((first, second, third))
        elif kind in (b"l", b"p"):
            elements += 1
        elif kind == b"#" and (match := _ANNOUNCED.match(line)):
            expected[match[2]] += int(match[1][:_DIGITS])
        if max(len(vertices), len(corners)) > 3 * MAX_VERTICES:
            raise DataError(
                f"the CAD model {path} has more than {MAX_VERTICES:,} vertices or triangles: simplify it or "
                "leave it out"
            )
    counted = {b"vertex positions": len(vertices) // 3, b"faces": elements}
    lacking = [
        f"{counted[kind]:,} of {number:,} {kind.decode()}"
        for kind, number in expected.items()
        if number > counted[kind]
    ]
    return " and ".join(lacking)


def _lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a file; a line that ends in a backslash is joined with the next."""
    with path.open("rb") as file:
        pieces: list[bytes] = []
        length = 0
        while piece := file.readline(_MAX_LINE_BYTES):
            pieces.append(piece)
            length += len(piece)
            if length >= _MAX_LINE_BYTES:
                raise ValueError("it has a line of more than a million bytes")
            if piece.endswith((b"\\\n", b"\\\r\n")):
                pieces[-1] = piece.rstrip(b"\\\r\n") + b" "
                continue
            yield b"".join(pieces)
            pieces, length = [], 0
        if pieces:
            yield b"".join(pieces)


def read_face_colors(path: Path, num_faces: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the colour of each triangle of an OBJ file: its material's diffuse one or its texture's mean.

    Colours make pictures prettier, nothing else depends on them: what is missing or damaged is grey. A
    texture outside of the model's folder is not opened; its material is grey too, and the log says so.

    Args:
        path: the OBJ file; its ``.mtl`` lies beside it, textures anywhere in the folder of the model.
        num_faces: number of triangles that ``read_obj`` finds in the file.

    Returns:
        ``(F,)`` int64 index of a colour, and the colours ``(G, 3)``, RGB in [0, 1], in steps of 1/255.
    """
    colors = _read_mtl(path.with_suffix(".mtl"))
    names, counts = _materials_of_faces(path, colors)
    if sum(counts) != num_faces:
        names, counts = [""], [num_faces]
    # Rounded to what a picture can show, so that materials of one colour become one.
    rounded = np.round(255 * np.array([colors.get(name, _GREY) for name in names])).astype(np.int64)
    unique, index = np.unique(rounded, axis=0, return_inverse=True)
    if len(unique) > _MAX_COLORS:
        unique, index = np.array([np.round(255 * np.array(_GREY))]), np.zeros(len(names), dtype=np.int64)
    return np.repeat(index.reshape(-1), counts).astype(np.int64), unique / 255


def _materials_of_faces(path: Path, colored: Collection[str]) -> tuple[list[str], list[int]]:
    """Return the names of the materials of successive runs of triangles, and the number of triangles of each.

    Polygons count as the triangles that ``read_obj`` cuts them into. Materials outside of ``colored`` are
    called "". A file may name any number of materials without a face between them: each of these comes once,
    at the end, with no triangle.
    """
    names, counts = [""], [0]
    used = {""}
    for line in _lines(path):
        words = line.split()
        if words[:1] == [b"usemtl"]:
            name = " ".join(line.decode(errors="replace").split()[1:])
            name = name if name in colored else ""
            used.add(name)
            if counts[-1]:
                names.append(name)
                counts.append(0)
            else:
                names[-1] = name
        elif words[:1] == [b"f"]:
            counts[-1] += max(len(words) - 3, 0)
    return [*names, *sorted(used)], [*counts, *[0] * len(used)]


def _read_mtl(path: Path) -> dict[str, tuple[float, float, float]]:
    """Return the colour of each material of an MTL file; a file that is missing has none."""
    colors: dict[str, tuple[float, float, float]] = {}
    textured: set[str] = set()
    outside: list[str] = []
    name = ""
    for line in _mtl_lines(path):
        words = line.split()
        if words[:1] == ["newmtl"]:
            name = " ".join(words[1:])
        elif words[:1] == ["Kd"] and name not in textured and (color := _color(words[1:])):
            colors[name] = color
        elif words[:1] == ["map_Kd"]:
            texture = _inside(path, words[-1])
            if texture is None:
                outside.append(words[-1])
            elif color := _mean_color(texture):
                colors[name] = color
                textured.add(name)
    if outside:
        _log.warning(
            "%s names %d textures outside of the model's folder, which are not read (%.80s): move them there",
            *(path, len(outside), outside[0]),
        )
    return colors


def _mtl_lines(path: Path) -> list[str]:
    """Return the lines of an MTL file, none if it is missing or too large."""
    try:
        if path.stat().st_size > _MAX_MTL_BYTES:
            _log.warning(
                "%s is larger than %d MB and not read: its model is grey", path, _MAX_MTL_BYTES >> 20
            )
            return []
        return path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def _color(words: list[str]) -> tuple[float, float, float] | None:
    try:
        red, green, blue = (min(max(float(word), 0.0), 1.0) for word in words[:3])
    except ValueError:
        return None
    return (red, green, blue)


def _inside(mtl: Path, name: str) -> Path | None:
    """Return the path of a texture, or None if it lies outside of the model's folder, also by a link."""
    try:
        path = (mtl.parent / name).resolve()
    except (OSError, ValueError):  # a name that no file can have
        return None
    return path if path.is_relative_to(mtl.parent.parent.resolve()) else None


def _mean_color(path: Path) -> tuple[float, float, float] | None:
    """Return a texture's mean colour, or None if it cannot be read."""
    try:
        with open_image(path) as image:
            if image.width * image.height > _MAX_TEXTURE_PIXELS:
                return None
            pixel = np.asarray(image.convert("RGB").resize((1, 1), Image.Resampling.BOX))[0, 0]
    except (*UNREADABLE, ConfigError):
        return None
    red, green, blue = (pixel / 255).tolist()
    return (red, green, blue)


def read_binvox(path: Path) -> tuple[NDArray[np.bool_], NDArray[np.float64], float]:
    """Read a binvox file.

    Returns:
        ``(S, S, S)`` bool indexed [x, y, z]; ``translate`` ``(3,)``; ``scale``. The centre of cell ``i`` lies
        at ``translate + (i + 0.5) / S * scale`` in the coordinates of the mesh.

    Raises:
        DataError: the file is missing or damaged.
    """
    try:
        if path.stat().st_size > _MAX_VOXEL_BYTES:
            raise ValueError(f"it is larger than {_MAX_VOXEL_BYTES / 2**20:.0f} MB")
        header, body = path.read_bytes().split(b"data\n", 1)
        fields = {
            words[0]: words[1:] for line in header.decode("ascii").splitlines() if (words := line.split())
        }
        size = int(fields["dim"][0])
        runs = np.frombuffer(body, dtype=np.uint8).reshape(-1, 2)
        # Both are tested before any cell is made: a few bytes can claim any number of cells.
        if (
            fields["dim"] != 3 * fields["dim"][:1]
            or not 0 < size <= _MAX_CELLS_A_SIDE
            or int(runs[:, 1].sum(dtype=np.int64)) != size**3
        ):
            raise ValueError(f"its runs do not fill {shown(' × '.join(fields['dim']))} cells")
        # The file runs over x, then z, then y (fastest).
        cells = np.repeat(runs[:, 0] > 0, runs[:, 1]).reshape(size, size, size).transpose(0, 2, 1)
        where = f"in {path}"
        translate = [float(word) for word in fields["translate"]]
        return (
            cells,
            as_numbers(translate, (3,), COORDINATE, f"translate {where}"),
            as_number(float(fields["scale"][0]), VOXEL_CUBE, f"scale {where}"),
        )
    except OSError as error:
        raise DataError(f"cannot read the voxels {path}: {error.strerror}; restore the file") from error
    except (ValueError, KeyError, IndexError) as error:
        raise DataError(f"the voxel file {path} is damaged ({str(error)[:80]}); restore the file") from error


def write_binvox(path: Path, cells: NDArray[np.bool_], translate: ArrayLike, scale: float) -> None:
    """Write ``(S, S, S)`` cells [x, y, z] as a binvox file; the reverse of :func:`read_binvox`."""
    flat = cells.transpose(0, 2, 1).reshape(-1)
    starts = np.flatnonzero(np.diff(flat, prepend=~flat[:1]))
    lengths = np.diff(starts, append=flat.size)
    # A run holds at most 255 cells: longer ones are cut into full runs and a rest.
    pieces = -(-lengths // 255)
    counts = np.full(int(pieces.sum()), 255, dtype=np.uint8)
    counts[np.cumsum(pieces) - 1] = (lengths - 1) % 255 + 1
    runs = np.stack([np.repeat(flat[starts], pieces).astype(np.uint8), counts], axis=1)
    sides = " ".join([str(cells.shape[0])] * 3)
    corner = " ".join(repr(float(value)) for value in np.asarray(translate))
    header = f"#binvox 1\ndim {sides}\ntranslate {corner}\nscale {float(scale)!r}\ndata\n"
    path.write_bytes(header.encode("ascii") + runs.tobytes())
