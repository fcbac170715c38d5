# SPDX-License-Identifier: Apache-2.0
"""Object meshes as files for other programs: a PLY and an OBJ each, in the colour of their class."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import trimesh

from raytran.structs import CLASS_COLORS, CLASSES, ObjectSet

_DECIMALS = 5
"""Digits behind the point in an OBJ: a hundredth of a millimetre."""


def object_name(objects: ObjectSet, index: int) -> str:
    """Return what an object is called in every file, e.g. ``00_chair``."""
    return f"{index:02d}_{CLASSES[int(objects.label[index])]}"


def write_meshes(
    folder: Path, objects: ObjectSet, meshes: Sequence[trimesh.Trimesh | None]
) -> list[str | None]:
    """Write ``meshes/NN.ply``, ``.obj`` and ``.mtl`` of each object that has a mesh, in place in the world.

    Args:
        folder: an existing folder.
        objects: ``M`` objects.
        meshes: for each object its mesh in world coordinates (metres, +Z up), or None.

    Returns:
        For each object the name of the PLY relative to ``folder``, or None.
    """
    (folder / "meshes").mkdir(exist_ok=True)
    names: list[str | None] = []
    for i, mesh in enumerate(meshes):
        if mesh is None:
            names.append(None)
            continue
        names.append(f"meshes/{i:02d}.ply")
        _painted(mesh, int(objects.label[i])).export(folder / f"meshes/{i:02d}.ply")
        _write_obj(folder / f"meshes/{i:02d}.obj", object_name(objects, i), mesh, int(objects.label[i]))
    return names


def _painted(mesh: trimesh.Trimesh, label: int) -> trimesh.Trimesh:
    painted = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    painted.visual = trimesh.visual.ColorVisuals(painted, vertex_colors=[*CLASS_COLORS[label], 255])
    return painted


def _write_obj(path: Path, name: str, mesh: trimesh.Trimesh, label: int) -> None:
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, metadata={"name": name})
    material = trimesh.visual.material.SimpleMaterial(
        name=CLASSES[label],
        diffuse=[*CLASS_COLORS[label], 255],
        ambient=[0, 0, 0, 255],
        specular=[0, 0, 0, 255],
    )
    solid.visual = trimesh.visual.TextureVisuals(material=material)
    library = path.with_suffix(".mtl")
    text, files = trimesh.exchange.obj.export_obj(
        solid,
        include_normals=False,
        return_texture=True,
        digits=_DECIMALS,
        mtl_name=library.name,
        header=None,
    )
    path.write_text(text.lstrip("\n"), encoding="ascii")
    library.write_bytes(files[library.name] + b"\n")
