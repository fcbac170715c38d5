# SPDX-License-Identifier: Apache-2.0
"""Which colour each triangle of a CAD model has: the diffuse one of its material, or its texture's mean."""

from __future__ import annotations

import logging
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

_log = logging.getLogger(__name__)

_GREY = (0.7, 0.7, 0.7)
_LARGEST_TEXTURE = 64 * 10**6
_MOST_COLORS = 256

_LARGEST_MTL = 4 * 2**20
"""Bytes of the largest material file that is read; ShapeNet's have some kilobytes."""


def read_face_colors(path: Path, num_faces: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the material of each triangle of an OBJ file and the materials' colours.

    Colours make pictures prettier, nothing else depends on them: what is missing or damaged is grey. So is
    what an MTL file names outside of the model's folder, which is not opened, and said in the log.

    Args:
        path: the OBJ file; its ``.mtl`` lies beside it, textures anywhere in the folder of the model.
        num_faces: how many triangles ``read_mesh`` finds in the file.

    Returns:
        ``(F,)`` int64 index of a colour, and the colours ``(G, 3)``, RGB in [0, 1], in steps of 1/255.
    """
    colors = _read_mtl(path.with_suffix(".mtl"))
    names, counts = _materials_of_faces(path, colors)
    if sum(counts) != num_faces:
        names, counts = [""], [num_faces]
    rounded = np.round(255 * np.array([colors.get(name, _GREY) for name in names])).astype(np.int64)
    unique, index = np.unique(rounded, axis=0, return_inverse=True)
    if len(unique) > _MOST_COLORS:
        unique, index = np.array([np.round(255 * np.array(_GREY))]), np.zeros(len(names), dtype=np.int64)
    return np.repeat(index.reshape(-1), counts).astype(np.int64), unique / 255


def _materials_of_faces(path: Path, known: Collection[str]) -> tuple[list[str], list[int]]:
    """Return runs of triangles as ``read_mesh`` cuts them: name of the material and how many there are.

    Materials that are not known are called "". A file may name any number without a face between them: these
    come once each, at the end.
    """
    names, counts = [""], [0]
    seen = {""}
    with path.open(encoding="utf-8", errors="replace") as file:
        held = ""
        for line in file:
            held += line.rstrip("\r\n")
            if held.endswith("\\"):
                held = held[:-1] + " "
                continue
            words, held = held.split(), ""
            if words[:1] == ["usemtl"]:
                name = " ".join(words[1:])
                name = name if name in known else ""
                seen.add(name)
                if counts[-1]:
                    names.append(name)
                    counts.append(0)
                else:
                    names[-1] = name
            elif words[:1] == ["f"]:
                counts[-1] += max(len(words) - 3, 0)
    return [*names, *sorted(seen)], [*counts, *[0] * len(seen)]


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
        if path.stat().st_size > _LARGEST_MTL:
            _log.warning("%s is larger than %d MB and not read: its model is grey", path, _LARGEST_MTL >> 20)
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
        with Image.open(path) as image:
            if image.width * image.height > _LARGEST_TEXTURE:
                return None
            pixel = np.asarray(image.convert("RGB").resize((1, 1), Image.Resampling.BOX))[0, 0]
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    red, green, blue = (pixel / 255).tolist()
    return (red, green, blue)
