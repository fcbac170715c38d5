# SPDX-License-Identifier: Apache-2.0
"""CAD models on disk in the layout of ShapeNetCore v2: meshes and voxels, read and written."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from raytran.data.voxelize import scan_convert
from raytran.errors import DataError

if TYPE_CHECKING:
    from raytran.data.rooms.cad import CadModel

STEM = "model_normalized"
"""Name without ending of every file of a model."""

BINVOX_SIZE = 128
"""Cells along each side of ShapeNet's voxel files."""


def model_folder(root: Path, catid: str, model_id: str) -> Path:
    """Return the folder of a model's files, below ``root`` or below ``root/ShapeNetCore.v2``.

    Raises:
        DataError: neither folder exists.
    """
    inside = Path(catid) / model_id / "models"
    for parent in (root, root / "ShapeNetCore.v2"):
        if (parent / inside).is_dir():
            return parent / inside
    raise DataError(
        f"no CAD model at {root / inside}; give the folder of ShapeNetCore.v2 that holds {catid}/{model_id}"
    )


def read_mesh(root: Path, catid: str, model_id: str) -> trimesh.Trimesh:
    """Read the mesh of a model, in ShapeNet's normalised frame.

    Only positions and faces are read, into one mesh of triangles; polygons are cut into fans, lines are left
    out. All vertices are kept, in the order of the file, also those that no face uses: ShapeNet's box and
    origin count them (trimesh's own reader drops them, and splits the others at texture seams).

    Args:
        root: folder that holds ``<catid>/<id>`` or ``ShapeNetCore.v2/<catid>/<id>``.
        catid: ShapeNet's synset, e.g. ``03001627``.
        model_id: ShapeNet's model name.

    Raises:
        DataError: the file is missing, damaged or without faces.
    """
    path = model_folder(root, catid, model_id) / f"{STEM}.obj"
    try:
        vertices, faces = _parse_obj(path.read_text(encoding="utf-8", errors="replace").splitlines())
    except OSError as error:
        raise DataError(f"cannot read the CAD model {path}: {error.strerror}; restore the file") from error
    except (ValueError, IndexError) as error:
        raise DataError(f"the CAD model {path} is damaged: {error}; restore the file") from error
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        raise DataError(f"the CAD model {path} has no faces or misses vertices; restore the file")
    return trimesh.Trimesh(vertices, faces, process=False)


def read_binvox(path: Path) -> tuple[NDArray[np.bool_], NDArray[np.float64], float]:
    """Read a binvox file.

    Returns:
        ``(S, S, S)`` bool indexed [x, y, z]; ``translate`` ``(3,)``; ``scale``. The centre of cell ``i`` lies
        at ``translate + (i + 0.5) / S * scale`` in the coordinates of the mesh.

    Raises:
        DataError: the file is missing or damaged.
    """
    try:
        header, body = path.read_bytes().split(b"data\n", 1)
        fields = {
            words[0]: words[1:] for line in header.decode("ascii").splitlines() if (words := line.split())
        }
        size = int(fields["dim"][0])
        runs = np.frombuffer(body, dtype=np.uint8).reshape(-1, 2)
        # The file runs over x, then z, then y (fastest).
        cells = np.repeat(runs[:, 0] > 0, runs[:, 1]).reshape(size, size, size).transpose(0, 2, 1)
        return cells, np.array(fields["translate"], dtype=np.float64), float(fields["scale"][0])
    except OSError as error:
        raise DataError(f"cannot read the voxels {path}: {error.strerror}; restore the file") from error
    except (ValueError, KeyError, IndexError) as error:
        raise DataError(f"the voxel file {path} is damaged ({error}); restore the file") from error


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
    place = " ".join(repr(float(value)) for value in np.asarray(translate))
    header = (
        f"#binvox 1\ndim {' '.join([str(cells.shape[0])] * 3)}\ntranslate {place}\nscale {scale!r}\ndata\n"
    )
    path.write_bytes(header.encode("ascii") + runs.tobytes())


def write_model(model: CadModel, root: Path) -> Path:
    """Write a generated model as ``root/<catid>/<id>/models/model_normalized.*`` and return that folder.

    A folder that is already there is left alone: its name is drawn from the model's content. Several
    processes may write the same model at once.
    """
    folder = root / model.catid / model.model_id / "models"
    if folder.is_dir():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=folder.parent) as unfinished:
        files = Path(unfinished) / "models"
        files.mkdir()
        (files / f"{STEM}.obj").write_text(_obj_text(model), encoding="ascii")
        (files / f"{STEM}.mtl").write_text(_mtl_text(model), encoding="ascii")
        (files / f"{STEM}.json").write_text(json.dumps(_facts(model)), encoding="ascii")
        _write_voxels(model, files)
        try:
            os.replace(files, folder)
        except OSError:
            # Another process may have finished the same model meanwhile.
            if not folder.is_dir():
                raise
    return folder


def _parse_obj(lines: Iterable[str]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the vertices ``(V, 3)`` and triangles ``(F, 3)`` of an OBJ file."""
    vertices: list[list[str]] = []
    faces: list[tuple[int, int, int]] = []
    for line in lines:
        if line.startswith("v "):
            vertices.append(line.split()[1:4])
        elif line.startswith("f "):
            corners = [int(word.split("/", 1)[0]) for word in line.split()[1:]]
            # Negative numbers count back from the newest vertex.
            first, *rest = [index - 1 if index > 0 else len(vertices) + index for index in corners]
            faces.extend((first, *pair) for pair in pairwise(rest))
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), np.array(faces, dtype=np.int64).reshape(-1, 3)


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
