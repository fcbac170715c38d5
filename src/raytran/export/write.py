# SPDX-License-Identifier: Apache-2.0
"""A prediction as files: ``scene.json``, ``scene.glb``, a PLY (and OBJ) of each mesh, ``occupancy.ply``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib import colormaps
from torch import Tensor

from raytran.classes import PAPER_CLASSES, Color
from raytran.data.files import write_text
from raytran.errors import ShapeError
from raytran.export.glb import object_name, turned_y_up, write_glb
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import yaw_from_rotation
from raytran.structs import ObjectSet, ScenePrediction

FORMAT = "raytran.scene/1"
"""Value of ``format``; the number rises when a reader of the old form could misread the new one."""

_OBJ_DECIMALS = 5
"""Digits behind the point in an OBJ: a hundredth of a millimetre."""

_METRE_DECIMALS = 4
"""Digits behind the point of lengths in ``scene.json``: a tenth of a millimetre."""

_SHARE_DECIMALS = 6
"""Digits behind the point of scores, radians and entries of rotations."""

_OCCUPIED = 0.5
"""Voxels with a higher probability are points."""

# trimesh writes no cloud without points, and no numbers of our own.
_PROPERTIES = {
    **dict.fromkeys(("x", "y", "z"), ("<f4", "float")),
    **dict.fromkeys(("red", "green", "blue"), ("u1", "uchar")),
    "probability": ("<f4", "float"),
}
"""Name of each property of a point in ``occupancy.ply`` → its type in numpy and in PLY."""


def write_prediction(
    folder: Path,
    prediction: ScenePrediction,
    meshes: Sequence[trimesh.Trimesh | None],
    *,
    cameras: Cameras | None = None,
    frame_ids: Sequence[str] = (),
    obj: bool = False,
) -> list[Path]:
    """Write ``scene.json``, ``scene.glb``, ``meshes/`` and ``occupancy.ply``.

    The JSON is written last, so a folder that holds it is complete.

    Args:
        folder: made if it is missing.
        prediction: ``M`` objects, possibly none; without ``occupancy`` or ``grid_extent`` there is no
            ``occupancy.ply``.
        meshes: for each object its mesh in world coordinates (metres), or None.
        cameras: ``(N,)`` cameras of the frames used, for ``scene.glb``; None: it has none.
        frame_ids: the name of each of the ``N`` frames.
        obj: write each mesh as OBJ too.

    Returns:
        The files, ``scene.json`` first.

    Raises:
        ShapeError: there are not as many meshes as objects, or frame names as cameras.
    """
    objects = prediction.objects
    if len(meshes) != len(objects):
        raise ShapeError(
            f"expected one mesh or None per object, got {len(meshes)} for {len(objects)} objects"
        )
    if cameras is not None and len(frame_ids) != len(cameras.intrinsics):
        raise ShapeError(
            f"expected a name for each frame, got {len(frame_ids)} for {len(cameras.intrinsics)} cameras"
        )
    folder.mkdir(parents=True, exist_ok=True)
    names = write_meshes(folder, objects, meshes, obj=obj)
    files = [write_glb(folder / "scene.glb", objects, meshes, cameras=cameras, frame_ids=frame_ids)]
    if (occupancy := prediction.occupancy) is not None and (extent := prediction.grid_extent) is not None:
        path, center = folder / "occupancy.ply", prediction.grid_center
        files.append(write_occupancy(path, occupancy, center=center, extent=extent))
    files += [folder / name for name in names if name is not None]
    return [write_scene_json(folder / "scene.json", prediction, names), *files]


def write_scene_json(path: Path, prediction: ScenePrediction, mesh_names: Sequence[str | None]) -> Path:
    """Write a prediction's objects, in their order, a line each.

    ``center`` and ``rotation`` are in the world of the input poses (+Z up, metres); ``size`` and ``rotation``
    follow the object frame (x width, y height, z depth; +Y up, front -Z); ``yaw`` is in radians. Where views
    were counted, ``num_views`` says how many saw the object's box and ``confidence`` is the score times
    ``n / (n + 1)`` of that number: what few saw is less certain than its score. Classes other than the
    paper's are listed under ``classes``, as ``Classes.settings`` gives them.

    Args:
        path: the file; written whole or not at all.
        prediction: its objects may be none.
        mesh_names: for each of the ``M`` objects the mesh file relative to ``path``'s folder, or None.

    Returns:
        ``path``.
    """
    objects = prediction.objects
    yaw, category = yaw_from_rotation(objects.rotation.double()), objects.category
    entries = []
    for i, mesh in enumerate(mesh_names):
        score = float(objects.score[i])
        entry: dict[str, Any] = {
            "category": category[i],
            "score": round(score, _SHARE_DECIMALS),
            "center": _rounded(objects.center[i].tolist(), _METRE_DECIMALS),
            "size": _rounded(objects.size[i].tolist(), _METRE_DECIMALS),
            "rotation": [_rounded(row, _SHARE_DECIMALS) for row in objects.rotation[i].tolist()],
            "yaw": round(float(yaw[i]), _SHARE_DECIMALS),
            "mesh": mesh,
        }
        if objects.num_views is not None:
            views = float(objects.num_views[i])
            entry["num_views"] = round(views, 1)
            entry["confidence"] = round(score * views / (views + 1), _SHARE_DECIMALS)
        if objects.model_id and objects.model_id[i]:
            entry["catid_cad"], entry["id_cad"] = objects.model_id[i].split("/", 1)
        entries.append(json.dumps(entry, allow_nan=False))
    content: dict[str, Any] = {"format": FORMAT, "scene_id": prediction.scene_id, "up": "+z", "unit": "m"}
    if objects.classes != PAPER_CLASSES:
        content["classes"] = objects.classes.settings()
    head = json.dumps(content, allow_nan=False)[:-1]
    listed = "[\n  " + ",\n  ".join(entries) + "\n ]" if entries else "[]"
    write_text(path, f'{head},\n "objects": {listed}}}\n')
    return path


def _rounded(values: Sequence[float], decimals: int) -> list[float]:
    """Return the numbers with so many digits behind the point, and no negative zero."""
    return [round(value, decimals) + 0.0 for value in values]


def write_meshes(
    folder: Path, objects: ObjectSet, meshes: Sequence[trimesh.Trimesh | None], *, obj: bool = False
) -> list[str | None]:
    """Write ``meshes/NN.ply`` of each object that has a mesh, in place, and ``.obj`` and ``.mtl`` if wanted.

    The PLY is in the world (+Z up), the OBJ has its axes as readers of OBJ expect them (+Y up).

    Args:
        folder: an existing folder.
        objects: ``M`` objects.
        meshes: for each object its mesh in world coordinates (metres, +Z up), or None.
        obj: write OBJ too.

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
        label = int(objects.label[i])
        name, color = objects.classes.names[label], objects.classes.colors[label]
        _painted(mesh, color).export(folder / f"meshes/{i:02d}.ply")
        if obj:
            path = folder / f"meshes/{i:02d}.obj"
            _write_obj(path, object_name(objects, i), mesh, material=name, color=color)
    return names


def _painted(mesh: trimesh.Trimesh, color: Color) -> trimesh.Trimesh:
    painted = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    painted.visual = trimesh.visual.ColorVisuals(painted, vertex_colors=[*color, 255])
    return painted


def _write_obj(path: Path, name: str, mesh: trimesh.Trimesh, *, material: str, color: Color) -> None:
    solid = turned_y_up(mesh)
    solid.metadata["name"] = name
    surface = trimesh.visual.material.SimpleMaterial(
        name=material,
        diffuse=[*color, 255],
        ambient=[0, 0, 0, 255],
        specular=[0, 0, 0, 255],
    )
    solid.visual = trimesh.visual.TextureVisuals(material=surface)
    library = path.with_suffix(".mtl")
    text, files = trimesh.exchange.obj.export_obj(
        solid,
        include_normals=False,
        return_texture=True,
        digits=_OBJ_DECIMALS,
        mtl_name=library.name,
        header=None,
    )
    path.write_text(text.lstrip("\n"), encoding="utf-8")
    library.write_bytes(files[library.name] + b"\n")


def write_occupancy(
    path: Path, occupancy: Tensor, *, center: Tensor, extent: tuple[float, float, float]
) -> Path:
    """Write the centres of the voxels that are likely occupied as a PLY, coloured by how likely.

    Colours run along matplotlib's ``viridis``, from dark violet at probability ½ to yellow at 1; the
    probability itself is the property ``probability``.

    Args:
        path: the file.
        occupancy: ``(X, Y, Z)`` probability.
        center: ``(3,)`` centre of the voxel grid in the world, metres.
        extent: sizes of the voxel grid, metres.

    Returns:
        ``path``.
    """
    x, y, z = occupancy.shape
    is_occupied = (occupancy > _OCCUPIED).cpu()
    centers = VoxelGrid((x, y, z), extent, center.double().cpu()).voxel_centers()[is_occupied].numpy()
    probability = occupancy.double().cpu()[is_occupied].numpy()
    colors = colormaps["viridis"]((probability - _OCCUPIED) / (1 - _OCCUPIED), bytes=True)
    points = np.empty(len(centers), dtype=[(name, kind) for name, (kind, _) in _PROPERTIES.items()])
    columns = (*centers.T, *colors[:, :3].T, probability)
    for name, column in zip(_PROPERTIES, columns, strict=True):
        points[name] = column
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property {kind} {name}" for name, (_, kind) in _PROPERTIES.items()]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode("ascii") + points.tobytes())
    return path
