# SPDX-License-Identifier: Apache-2.0
"""Which colour each triangle of a CAD model has: the diffuse one of its material, or its texture's mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

_GREY = (0.7, 0.7, 0.7)
_LARGEST_TEXTURE = 64 * 10**6
_MOST_COLORS = 256


def read_face_colors(path: Path, num_faces: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the material of each triangle of an OBJ file and the materials' colours.

    Colours make pictures prettier, nothing else depends on them: what is missing or damaged is grey.

    Args:
        path: the OBJ file; its ``.mtl`` lies beside it, textures anywhere in the folder of the model.
        num_faces: how many triangles ``read_mesh`` finds in the file.

    Returns:
        ``(F,)`` int64 index of a colour, and the colours ``(G, 3)``, RGB in [0, 1], in steps of 1/255.
    """
    names, counts = _materials_of_faces(path)
    colors = _read_mtl(path.with_suffix(".mtl"))
    if sum(counts) != num_faces:
        names, counts = [""], [num_faces]
    rounded = np.round(255 * np.array([colors.get(name, _GREY) for name in names])).astype(np.int64)
    unique, index = np.unique(rounded, axis=0, return_inverse=True)
    if len(unique) > _MOST_COLORS:
        unique, index = np.array([np.round(255 * np.array(_GREY))]), np.zeros(len(names), dtype=np.int64)
    return np.repeat(index.reshape(-1), counts).astype(np.int64), unique / 255


def _materials_of_faces(path: Path) -> tuple[list[str], list[int]]:
    """Return runs of triangles as ``read_mesh`` cuts them: name of the material and how many there are."""
    names, counts = [""], [0]
    with path.open(encoding="utf-8", errors="replace") as file:
        held = ""
        for line in file:
            held += line.rstrip("\r\n")
            if held.endswith("\\"):
                held = held[:-1] + " "
                continue
            words, held = held.split(), ""
            if words[:1] == ["usemtl"]:
                names.append(" ".join(words[1:]))
                counts.append(0)
            elif words[:1] == ["f"]:
                counts[-1] += max(len(words) - 3, 0)
    return names, counts


def _read_mtl(path: Path) -> dict[str, tuple[float, float, float]]:
    """Return the colour of each material of an MTL file; a file that is missing has none."""
    colors: dict[str, tuple[float, float, float]] = {}
    textured: set[str] = set()
    name = ""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return colors
    for line in lines:
        words = line.split()
        if words[:1] == ["newmtl"]:
            name = " ".join(words[1:])
        elif words[:1] == ["Kd"] and name not in textured and (color := _color(words[1:])):
            colors[name] = color
        elif words[:1] == ["map_Kd"] and (color := _mean_color(path, words[-1])):
            colors[name] = color
            textured.add(name)
    return colors


def _color(words: list[str]) -> tuple[float, float, float] | None:
    try:
        red, green, blue = (min(max(float(word), 0.0), 1.0) for word in words[:3])
    except ValueError:
        return None
    return (red, green, blue)


def _mean_color(mtl: Path, name: str) -> tuple[float, float, float] | None:
    """Return a texture's mean colour, or None if it cannot be read or lies outside the model's folder."""
    path = (mtl.parent / name).resolve()
    if not path.is_relative_to(mtl.parent.parent.resolve()):
        return None
    try:
        with Image.open(path) as image:
            if image.width * image.height > _LARGEST_TEXTURE:
                return None
            pixel = np.asarray(image.convert("RGB").resize((1, 1), Image.Resampling.BOX))[0, 0]
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    red, green, blue = (pixel / 255).tolist()
    return (red, green, blue)
