# SPDX-License-Identifier: Apache-2.0
"""Reads a piece of a furniture library as one mesh in ShapeNet's frame, with one colour per material."""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from raytran.data.images import IMAGE_KINDS
from raytran.errors import DataError
from raytran.rooms.sweethome3d.catalogue import FurnitureLibrary, Piece

# It logs every polygon that it triangulates.
logging.getLogger("trimesh").setLevel(logging.WARNING)

MOST_FACES = 100_000
"""Models with more triangles are left out: a room of them would take minutes to render."""

_MOST_CORNERS = 6 * MOST_FACES
"""A model with more corners of faces is not parsed: that would take ten times its size in memory."""

_LARGEST_TEXTURE = 64 * 10**6
_GREY = np.full(3, 0.7)
_TEXTURE_SIDE = 256


@dataclass(frozen=True)
class PieceMesh:
    """A piece in metres, +Y up, front -Z, the middle of its box at the origin.

    Attributes:
        vertices: ``(V, 3)`` float64, every position once.
        faces: ``(F, 3)`` int64.
        face_group: ``(F,)`` int64 material index.
        group_color: ``(G, 3)`` RGB in [0, 1], the mean colour of each material.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_group: NDArray[np.int64]
    group_color: NDArray[np.float64]


def read_piece(library: FurnitureLibrary, piece: Piece, turn_deg: float = 0.0) -> PieceMesh:
    """Read a piece as Sweet Home 3D shows it: rotated upright and stretched to the catalogue's sizes.

    Args:
        library: the open library.
        piece: its entry.
        turn_deg: correction of the entry's rotation, about +Y, for pieces whose front is elsewhere.

    Raises:
        DataError: the model is missing, damaged, empty, flat or has more than ``MOST_FACES`` triangles.
    """
    data = library.read(piece.model)
    corners = _corners(data)
    if corners > _MOST_CORNERS:
        raise DataError(
            f"{piece.model} in {library.path} has faces of {corners:,} corners: it is no furniture"
        )
    try:
        resolver = library.files_beside(piece.model)
        with np.errstate(all="ignore"):  # what numbers there are is looked at below
            scene = trimesh.load_scene(io.BytesIO(data), file_type="obj", resolver=resolver)
    except (ValueError, IndexError, KeyError, TypeError, OSError, Image.DecompressionBombError) as error:
        raise DataError(
            f"{piece.model} in {library.path} is damaged ({str(error)[:80]!r}); copy it again"
        ) from error
    parts = [
        part for part in scene.geometry.values() if isinstance(part, trimesh.Trimesh) and len(part.faces)
    ]
    count = sum(len(part.faces) for part in parts)
    if not 0 < count <= MOST_FACES:
        raise DataError(f"{piece.model} in {library.path} has {count} triangles, not 1 to {MOST_FACES}")
    if any(
        part.vertices.shape[1:] != (3,) or part.faces.min() < 0 or part.faces.max() >= len(part.vertices)
        for part in parts
    ):
        raise DataError(f"{piece.model} in {library.path} has faces of vertices that it lacks; copy it again")
    triangles = np.concatenate([part.vertices[part.faces] for part in parts])
    vertices, index = np.unique(_placed(triangles, piece, turn_deg), axis=0, return_inverse=True)
    if not np.isfinite(vertices).all():
        raise DataError(f"{piece.model} in {library.path} is flat or holds numbers that are not finite")
    faces = index.reshape(-1, 3)
    solid = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    group = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    return PieceMesh(vertices, faces[solid], group[solid], np.array([_color(part) for part in parts]))


def _corners(obj: bytes) -> int:
    """Return about how many corners the faces of an OBJ file have, without parsing it."""
    return sum(line.count(b" ") + line.count(b"\t") for line in io.BytesIO(obj) if line.startswith(b"f"))


def _placed(triangles: NDArray[np.float64], piece: Piece, turn_deg: float) -> NDArray[np.float64]:
    """Return corners ``(3F, 3)`` turned to ShapeNet's front, as large as the catalogue says."""
    turn = np.deg2rad(turn_deg)
    about_up = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    points = triangles.reshape(-1, 3) @ (about_up @ piece.rotation).T
    low, high = points.min(axis=0), points.max(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = (points - (low + high) / 2) / (high - low) * piece.size_m
    # Half a turn about the up axis: Sweet Home 3D's front is +Z, ShapeNet's is -Z. Whole micrometres weld
    # what the file wrote twice.
    placed: NDArray[np.float64] = np.round(points * np.array([-1.0, 1.0, -1.0]), 6) + 0.0
    return placed


def _color(part: trimesh.Trimesh) -> NDArray[np.float64]:
    """Return the mean colour ``(3,)`` of a part: of its texture where its faces use it, else its diffuse."""
    visual: Any = part.visual
    material = getattr(visual, "material", None)
    if material is None:
        return _GREY
    image: Any = getattr(material, "image", None)
    uv: Any = getattr(visual, "uv", None)
    # trimesh opens files of any kind; nothing of them is decoded before this.
    is_readable = image is not None and image.format in IMAGE_KINDS
    if uv is None or not is_readable or image.width * image.height > _LARGEST_TEXTURE:
        return np.asarray(material.main_color, dtype=np.float64)[:3] / 255
    texture = np.asarray(image.convert("RGB").resize((_TEXTURE_SIDE, _TEXTURE_SIDE), Image.Resampling.BOX))
    middle = np.nan_to_num(np.asarray(uv)[part.faces].mean(axis=1)) % 1.0
    column = np.minimum((middle[:, 0] * _TEXTURE_SIDE).astype(int), _TEXTURE_SIDE - 1)
    row = np.minimum(((1 - middle[:, 1]) * _TEXTURE_SIDE).astype(int), _TEXTURE_SIDE - 1)
    weight = part.area_faces + 1e-12
    color: NDArray[np.float64] = (texture[row, column] * weight[:, None]).sum(axis=0) / weight.sum() / 255
    return color
