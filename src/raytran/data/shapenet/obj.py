# SPDX-License-Identifier: Apache-2.0
"""OBJ files as ShapeNet has them: positions and faces read with bounded memory, positions replaced."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from raytran.errors import DataError

_MAX_COUNT = 10_000_000
"""Most vertices, and most triangles, of a model that is read."""

_FARTHEST = 1e100
"""Coordinates at or beyond this, and those that are no number, count as damage: their box would overflow."""

_MAX_LINE = 1 << 20
"""Longest line that is read, bytes."""

# What the converter of ShapeNetCore v2 (assimp) says of its own file. It counts lines and points as faces.
_ANNOUNCED = re.compile(rb"# (?:Mesh '.*' with )?(\d+) (vertex positions|faces)\s*$")


def read_obj(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read positions and faces of an OBJ file into one mesh of triangles.

    Polygons are cut into fans, negative numbers count back from the newest vertex, and groups, materials,
    lines, points and faces of two corners (edges, in ShapeNetCore v1) are left out.

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
        raise DataError(f"the CAD model {path} is damaged: {error}; restore the file") from error
    if announced:
        raise DataError(f"the CAD model {path} ends early: {announced}; restore the file")
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(corners, dtype=np.int64).reshape(-1, 3)
    if not len(faces) or faces.min() < 0 or faces.max() >= len(points):
        raise DataError(f"the CAD model {path} has no faces or misses vertices; restore the file")
    if not (np.abs(points) < _FARTHEST).all():
        raise DataError(f"the CAD model {path} has vertices that are not finite; restore the file")
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
    """Fill the coordinates and the corners of triangles; return what the file announces but lacks."""
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
            numbers = [int(word.partition(b"/")[0]) for word in words[1:]]
            first, *rest = [number - 1 if number > 0 else count + number for number in numbers]
            for second, third in pairwise(rest):
                corners.extend((first, second, third))
        elif kind in (b"l", b"p"):
            elements += 1
        elif kind == b"#" and (match := _ANNOUNCED.match(line)):
            expected[match[2]] += int(match[1])
        if max(len(vertices), len(corners)) > 3 * _MAX_COUNT:
            raise DataError(
                f"the CAD model {path} has more than {_MAX_COUNT:,} vertices or triangles: simplify it or "
                "leave it out"
            )
    found = {b"vertex positions": len(vertices) // 3, b"faces": elements}
    lacking = [
        f"{found[kind]:,} of {number:,} {kind.decode()}"
        for kind, number in expected.items()
        if number > found[kind]
    ]
    return " and ".join(lacking)


def _lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a file, those that end in a backslash joined with the next."""
    with path.open("rb") as file:
        held: list[bytes] = []
        length = 0
        while line := file.readline(_MAX_LINE):
            held.append(line)
            length += len(line)
            if length >= _MAX_LINE:
                raise ValueError("it has a line of more than a million bytes")
            if line.endswith((b"\\\n", b"\\\r\n")):
                held[-1] = line.rstrip(b"\\\r\n") + b" "
                continue
            yield b"".join(held)
            held, length = [], 0
        if held:
            yield b"".join(held)
