# SPDX-License-Identifier: Apache-2.0
"""Writes generated CAD models in the layout of ShapeNetCore v2."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from raytran.data.files import finished_folder
from raytran.data.shapenet.meshes import write_binvox
from raytran.data.shapenet.models import STEM
from raytran.data.shapenet.voxelize import scan_convert

if TYPE_CHECKING:
    from raytran.rooms.cad import CadModel

BINVOX_SIZE = 128
"""Cells along each side of ShapeNet's voxel files."""


def write_model(model: CadModel, root: Path, *, extra: Mapping[str, object] | None = None) -> Path:
    """Write a generated model as ``root/<catid>/<id>/models/model_normalized.*`` and return that folder.

    A folder that exists is left as it is, because its name is a digest of the model's content. Several
    processes may write the same model at once.

    Args:
        model: the model.
        root: folder in ShapeNet's layout.
        extra: further entries of the model's ``.json``.
    """
    folder = root / model.catid / model.model_id / "models"
    if folder.is_dir():
        return folder
    with finished_folder(folder) as files:
        (files / f"{STEM}.obj").write_text(_obj_text(model), encoding="ascii")
        (files / f"{STEM}.mtl").write_text(_mtl_text(model), encoding="ascii")
        (files / f"{STEM}.json").write_text(json.dumps(_facts(model) | dict(extra or {})), encoding="ascii")
        _write_voxels(model, files)
    return folder


def _obj_text(model: CadModel) -> str:
    """Return the OBJ file: vertices, one normal a face, faces grouped by material."""
    corners = model.vertices[model.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    lines = [f"mtllib {STEM}.mtl"]
    lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in model.vertices.tolist()]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normals.tolist()]
    for group in np.unique(model.face_group).tolist():
        lines += [f"g part_{group}", f"usemtl material_{group}"]
        chosen = np.flatnonzero(model.face_group == group)
        rows = np.column_stack([model.faces[chosen] + 1, chosen + 1]).tolist()
        lines += [f"f {a}//{n} {b}//{n} {c}//{n}" for a, b, c, n in rows]
    return "\n".join(lines) + "\n"


def _mtl_text(model: CadModel) -> str:
    """Return the MTL file: one diffuse colour a material."""
    groups, first = np.unique(model.face_group, return_index=True)
    lines = []
    for group, color in zip(groups.tolist(), model.face_color[first].tolist(), strict=True):
        lines += [f"newmtl material_{group}", "Kd {:.4f} {:.4f} {:.4f}".format(*color), ""]
    return "\n".join(lines)


def _facts(model: CadModel) -> dict[str, object]:
    """Return the JSON file: the box and mean vertex before normalisation, here in metres above the floor."""
    low, high = model.vertices.min(axis=0), model.vertices.max(axis=0)
    diagonal = float(np.linalg.norm(model.size_m))
    centroid = -diagonal * np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    return {
        "id": model.model_id,
        "numVertices": len(model.vertices),
        "min": (diagonal * low + centroid).tolist(),
        "max": (diagonal * high + centroid).tolist(),
        "centroid": centroid.tolist(),
    }


def _write_voxels(model: CadModel, folder: Path) -> None:
    """Write the surface and the solid voxels over the cube that starts at the box's lower corner."""
    low, scale = model.vertices.min(axis=0), float(np.ptp(model.vertices, axis=0).max())
    points = (model.vertices - low) / scale * BINVOX_SIZE
    solid, surface = scan_convert(points, model.faces, BINVOX_SIZE)
    write_binvox(folder / f"{STEM}.solid.binvox", solid | surface, low, scale)
    write_binvox(folder / f"{STEM}.surface.binvox", surface, low, scale)
