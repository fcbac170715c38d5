# SPDX-License-Identifier: Apache-2.0
"""Object meshes as files: one PLY each, and one GLB with all of them in their class colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

from raytran.types import CLASS_COLORS, CLASSES, ObjectSet

_Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def write_meshes(
    folder: Path, objects: ObjectSet, meshes: Sequence[trimesh.Trimesh | None]
) -> list[str | None]:
    """Write ``meshes/NN.ply`` for each object that has a mesh, in place in the world, in its class colour.

    Args:
        folder: an existing folder.
        objects: ``M`` objects.
        meshes: for each object its mesh in world coordinates (metres, +Z up), or None.

    Returns:
        For each object the name relative to ``folder``, or None.
    """
    (folder / "meshes").mkdir(exist_ok=True)
    names: list[str | None] = []
    for i, mesh in enumerate(meshes):
        if mesh is None:
            names.append(None)
            continue
        names.append(f"meshes/{i:02d}.ply")
        _painted(mesh, int(objects.label[i])).export(folder / f"meshes/{i:02d}.ply")
    return names


def write_glb(path: Path, objects: ObjectSet, meshes: Sequence[trimesh.Trimesh | None]) -> Path:
    """Write all meshes as one glTF scene whose nodes are called ``NN_category``.

    Geometry keeps the world coordinates of the poses (+Z up); the parent node ``world_z_up`` turns them to
    glTF's +Y up, so that every viewer shows the room upright. A scene without meshes holds that node alone.

    Args:
        path: the file.
        objects: ``M`` objects.
        meshes: for each object its mesh in world coordinates, or None.
    """
    scene = trimesh.Scene()
    scene.graph.update(frame_from=scene.graph.base_frame, frame_to="world_z_up", matrix=_Y_UP_FROM_Z_UP)
    for i, mesh in enumerate(meshes):
        if mesh is not None:
            label = int(objects.label[i])
            name = f"{i:02d}_{CLASSES[label]}"
            material = trimesh.visual.material.PBRMaterial(
                name=CLASSES[label],
                baseColorFactor=[*CLASS_COLORS[label], 255],
                metallicFactor=0.0,
                roughnessFactor=0.8,
                doubleSided=True,
            )
            solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
            solid.visual = trimesh.visual.TextureVisuals(material=material)
            scene.add_geometry(solid, node_name=name, geom_name=name, parent_node_name="world_z_up")
    # `Scene.export` refuses a scene without geometry; a file with no objects in it is what we mean.
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene, include_normals=True))
    return path


def _painted(mesh: trimesh.Trimesh, label: int) -> trimesh.Trimesh:
    painted = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    painted.visual = trimesh.visual.ColorVisuals(painted, vertex_colors=[*CLASS_COLORS[label], 255])
    return painted
