# SPDX-License-Identifier: Apache-2.0
"""One glTF file of a whole scene: meshes, boxes and cameras, each a node with a name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from raytran.classes import Classes
from raytran.geometry.camera import Cameras
from raytran.structs import ObjectSet

ROOT = "scene_y_up"
"""Node above all others, which leaves them where they are."""

_Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From the world (+Z up) to the axes of glTF and OBJ: (x, y, z) becomes (x, z, -y)."""

_EDGE = 0.008
"""Thickness of a box's edges, metres; those of the front face are twice as thick."""

_NEAR = 0.05
"""Near plane of the cameras, metres."""


def turned_y_up(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh of the world (+Z up) in the axes that readers of glTF and OBJ expect (+Y up).

    The vertices themselves are turned, to the last bit as they were: many readers ignore nodes.
    """
    vertices = np.asarray(mesh.vertices) @ _Y_UP_FROM_Z_UP[:3, :3].T + 0.0  # no -0
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def object_name(objects: ObjectSet, index: int) -> str:
    """Return what an object is called in every file, e.g. ``00_chair``."""
    return f"{index:02d}_{objects.classes.names[int(objects.label[index])]}"


def write_glb(
    path: Path,
    objects: ObjectSet,
    meshes: Sequence[trimesh.Trimesh | None],
    *,
    cameras: Cameras | None = None,
    frame_ids: Sequence[str] = (),
) -> Path:
    """Write a scene as glTF; a mesh is the node ``NN_class``, its object's box the node ``NN_class_box``.

    glTF is +Y up, and so are the vertices: a point (x, y, z) of the world is (x, z, -y). The nodes of meshes
    and boxes move nothing. A box is its twelve edges as thin bars, those of the front bolder. Each frame is a
    glTF camera in the node ``camera_FRAME`` below the node ``cameras``; glTF knows no principal point, so one
    beside the middle of the image is lost.

    Args:
        path: the file.
        objects: ``M`` objects.
        meshes: for each object its mesh in world coordinates, or None.
        cameras: ``(N,)`` cameras of the frames used, or None.
        frame_ids: the name of each of the ``N`` frames.

    Returns:
        ``path``.
    """
    scene = trimesh.Scene()
    scene.graph.update(frame_from=scene.graph.base_frame, frame_to=ROOT)
    for i, mesh in enumerate(meshes):
        label, name = int(objects.label[i]), object_name(objects, i)
        if mesh is not None:
            _add(scene, name, mesh, objects.classes, label)
        _add(scene, f"{name}_box", _box_edges(objects, i), objects.classes, label)

    def complete(tree: dict[str, Any]) -> None:
        for material in tree.get("materials", ()):
            color = _linear(objects.classes.colors[objects.classes.index(material["name"])])
            material["pbrMetallicRoughness"]["baseColorFactor"] = [*color, 1.0]
        if cameras is not None:
            _add_cameras(tree, cameras, frame_ids)

    # `Scene.export` refuses a scene without geometry; a file with no objects in it is what we mean.
    content = trimesh.exchange.gltf.export_glb(scene, include_normals=True, tree_postprocessor=complete)
    path.write_bytes(content)
    return path


def _linear(color: Sequence[int]) -> list[float]:
    """Return a colour of display values in [0, 255] as glTF wants it: linear light (IEC 61966-2-1)."""
    values = [value / 255 for value in color]
    return [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in values]


def _add(scene: trimesh.Scene, name: str, mesh: trimesh.Trimesh, classes: Classes, label: int) -> None:
    turned = turned_y_up(mesh)
    solid = trimesh.Trimesh(turned.vertices, turned.faces, vertex_normals=_normals(turned), process=False)
    # Its colour is set in the finished file: trimesh rounds colours to 256 steps, too few for linear light.
    material = trimesh.visual.material.PBRMaterial(
        name=classes.names[label],
        baseColorFactor=[*classes.colors[label], 255],
        metallicFactor=0.0,
        roughnessFactor=0.8,
        doubleSided=True,
    )
    solid.visual = trimesh.visual.TextureVisuals(material=material)
    scene.add_geometry(solid, node_name=name, geom_name=name, parent_node_name=ROOT)


def _normals(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Return the normals of vertices, the mean of their triangles' by area.

    So a large flat side looks flat up to its edges, which rounds only the small triangles along them.
    """
    first, second, third = np.asarray(mesh.vertices)[np.asarray(mesh.faces)].swapaxes(0, 1)
    cross = np.repeat(np.cross(second - first, third - first), 3, axis=0)
    corner, count = np.asarray(mesh.faces).ravel(), len(mesh.vertices)
    normal = np.stack([np.bincount(corner, axis, minlength=count) for axis in cross.T], axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.where(length > 0, normal / np.where(length > 0, length, 1.0), (0.0, 1.0, 0.0))


def _box_edges(objects: ObjectSet, index: int) -> trimesh.Trimesh:
    """Return the edges of an object's box as twelve bars, in the world."""
    size, rotation, center = (
        value[index].detach().double().cpu().numpy()
        for value in (objects.size, objects.rotation, objects.center)
    )
    bar = trimesh.creation.box()
    vertices: list[NDArray[np.float64]] = []
    # An edge runs along one axis, at either end of the two others.
    for axis, *ends in product(range(3), (-0.5, 0.5), (-0.5, 0.5)):
        middle = np.insert(np.array(ends, dtype=np.float64), axis, 0.0)  # of the edge, in units of the box
        thickness = _EDGE * (2 if middle[2] < 0 else 1)
        extents = np.full(3, thickness)
        extents[axis] += size[axis]
        vertices.append(bar.vertices * extents + middle * size)
    faces = [bar.faces + i * len(bar.vertices) for i in range(len(vertices))]
    corners = np.concatenate(vertices) @ rotation.T + center
    return trimesh.Trimesh(corners, np.concatenate(faces), process=False)


def _add_cameras(tree: dict[str, Any], cameras: Cameras, frame_ids: Sequence[str]) -> None:
    """Add a camera for each frame to glTF's JSON; a glTF camera looks along its own -Z, with +Y up."""
    height, width = cameras.image_size
    nodes: list[dict[str, Any]] = tree["nodes"]
    root = next(node for node in nodes if node.get("name") == ROOT)
    poses = _Y_UP_FROM_Z_UP @ cameras.world_from_camera.double().cpu().numpy() * np.array([1.0, -1, -1, 1])
    first = len(nodes) + 1
    nodes.append({"name": "cameras", "children": list(range(first, first + len(poses)))})
    root.setdefault("children", []).append(first - 1)
    focal = cameras.intrinsics[:, [0, 1], [0, 1]].double().tolist()
    tree["cameras"] = [
        {
            "type": "perspective",
            "perspective": {
                "yfov": 2 * math.atan(height / 2 / along_y),
                "aspectRatio": width / along_x / (height / along_y),
                "znear": _NEAR,
            },
        }
        for along_x, along_y in focal
    ]
    for n, (name, pose) in enumerate(zip(frame_ids, poses, strict=True)):
        # glTF's matrices are column-major.
        nodes.append({"name": f"camera_{name}", "camera": n, "matrix": pose.T.ravel().tolist()})
