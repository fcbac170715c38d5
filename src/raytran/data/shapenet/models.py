# SPDX-License-Identifier: Apache-2.0
"""The CAD models of ShapeNetCore v1 and v2: find, read and copy them, always in the frame of v2.

In v2 the front of a model is -Z, the diagonal of its box is 1 and the origin is its mean vertex. In v1 the
front is +X and the model lies in a unit cube around the origin: we turn it by +90° about +Y and normalise it
as in v2. The two releases were converted from the source files by different programs, so the
mean vertices of one model can differ a little; its box does not. A few models of v1 are mirrored left to
right, which the box alone cannot tell: use v2, for which Scan2CAD was annotated, if you have the choice.

Where objects have no CAD model, what of a scan's mesh stands in an object's box takes its place (``BOXED``).
"""

from __future__ import annotations

import json
import logging
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from raytran.data.files import finished_folder
from raytran.data.shapenet.meshes import MAX_VERTICES, read_binvox, read_obj, replaced_obj, write_binvox
from raytran.data.text import read_json_object
from raytran.errors import DataError
from raytran.limits import COORDINATE, as_count, as_numbers

_log = logging.getLogger(__name__)

STEM = "model_normalized"
"""Name without ending of every file of a model."""

BOXED = "in_box.obj"
"""Mesh of one object of a scan, in the object's frame with the object's box as the cube [-½, ½]³. Unlike that
of a CAD model it need not reach the sides of the box: a scan sees parts of things."""

BOX_MODEL = "box"
"""Model name of objects of which nothing but the box is known; their mesh is the box."""

Version = Literal["v1", "v2", "boxed"]

V2_FROM_V1 = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Rotation from v1's axes (front +X) to v2's (front -Z)."""

# Where the categories may lie below the folder that somebody calls ShapeNet: unpacked archives nest.
_NESTS = (
    *(".", "ShapeNetCore.v2", "ShapeNetCore.v2/ShapeNetCore.v2", "ShapeNetCore", "shapenet"),
    *("ShapeNetCore.v1", "ShapeNetCore.v1/ShapeNetCore.v1"),
)
_MESHES: tuple[tuple[str, Version], ...] = (
    (f"models/{STEM}.obj", "v2"),
    ("model.obj", "v1"),
    ("models/model.obj", "v1"),
    (f"models/{BOXED}", "boxed"),
)
_LEAST_DIAGONAL = 1e-12
"""Of a box, in the unit of the file: what is smaller is one point, whose size cannot be made 1."""

_MAX_FACTS = 2**20
"""Bytes of the largest ``.json`` that is read; ShapeNet's have less than one kilobyte."""

_NAME = re.compile(r"\w[\w .\-]*")
_CATEGORY = "[0-9]" * 8


@dataclass(frozen=True)
class ModelFacts:
    """What a model's ``.json`` file says of the mesh before it was normalised.

    Attributes:
        num_vertices: of the file, also those that no face uses.
        low: ``(3,)`` lower corner of the box of all vertices, in the units of the source.
        high: ``(3,)`` upper corner.
        centroid: ``(3,)`` mean vertex; normalised = (original - centroid) / |high - low|.
    """

    num_vertices: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    centroid: NDArray[np.float64]


def shapenet_version(root: Path) -> Version:
    """Return the release that a folder holds, judged by its first model; v2 if it holds both.

    Raises:
        DataError: there is no model of either release.
    """
    for nest in _NESTS:
        for category in sorted((root / nest).glob(_CATEGORY)):
            for model in sorted(category.glob("*/")):
                mesh = _mesh_below(model)
                if mesh is not None:
                    return mesh[1]
    packed = sorted(path.name for path in root.glob("*.zip"))
    remedy = f"unpack {packed[0]} there" if packed else "give the folder that holds ShapeNetCore.v2"
    raise DataError(f"no CAD model of ShapeNetCore v1 or v2 lies in {root}; {remedy}")


def has_model(root: Path, catid: str, model_id: str) -> bool:
    """Return whether the mesh file of a model exists; it is not opened."""
    return _find_mesh(root, catid, model_id) is not None


def categories(root: Path) -> list[str]:
    """Return the synsets that have a folder, of either release, sorted; a folder may hold no model."""
    return sorted({folder.name for nest in _NESTS for folder in (root / nest).glob(f"{_CATEGORY}/")})


def model_names(root: Path, catid: str) -> list[str]:
    """Return the names of all models of a category that have a mesh file, of either release, sorted."""
    folders = {folder.name for nest in _NESTS for folder in (root / nest / catid).glob("*/")}
    return sorted(name for name in folders if has_model(root, catid, name))


def mesh_path(root: Path, catid: str, model_id: str) -> Path:
    """Return the OBJ file of a model, of v2 if both releases have it.

    Args:
        root: folder that holds ``<catid>/<id>``, or ``ShapeNetCore.v2`` or ``ShapeNetCore.v1`` with these.
        catid: ShapeNet's synset, e.g. ``03001627``.
        model_id: ShapeNet's model name.

    Raises:
        DataError: there is no such file.
    """
    return _mesh_of(root, catid, model_id)[0]


def is_boxed(root: Path, catid: str, model_id: str) -> bool:
    """Return whether a model is what stands in an object's own box, see ``BOXED``; see ``mesh_path``."""
    return _mesh_of(root, catid, model_id)[1] == "boxed"


def has_own_shape(model_id: str) -> bool:
    """Return whether more than the box is known of objects with the model ``catid/id``."""
    return model_id.rpartition("/")[2] != BOX_MODEL


def model_folder(root: Path, catid: str, model_id: str) -> Path:
    """Return the folder of a model's files; see ``mesh_path``."""
    return mesh_path(root, catid, model_id).parent


def read_mesh(root: Path, catid: str, model_id: str) -> trimesh.Trimesh:
    """Read the mesh of a model, in ShapeNetCore v2's normalised frame.

    Only positions and faces are read, into one mesh of triangles; polygons are cut into fans, lines are left
    out. All vertices are kept, in the order of the file, also those that no face uses: ShapeNet's box and
    origin count them (trimesh's own reader drops them, and splits the others at texture seams).

    Args:
        root: as for ``mesh_path``.
        catid: ShapeNet's synset, e.g. ``03001627``.
        model_id: ShapeNet's model name.

    Raises:
        DataError: the file is missing, damaged or without faces.
    """
    path, version = _mesh_of(root, catid, model_id)
    vertices, faces = read_obj(path)
    if version == "v1":
        vertices = _normalised(vertices, _facts_of_v1(path, vertices))
    return trimesh.Trimesh(vertices, faces, process=False)


def read_facts(root: Path, catid: str, model_id: str) -> ModelFacts:
    """Read the facts of a model before it was normalised; of v1, those of the mesh rotated to v2's axes.

    Raises:
        DataError: the file is missing or damaged.
    """
    path, version = _mesh_of(root, catid, model_id)
    if version == "v1":
        return _facts_of_v1(path, read_obj(path)[0])
    path = path.with_suffix(".json")
    values = read_json_object(path, max_bytes=_MAX_FACTS)
    low, high, centroid = (
        as_numbers(values.get(key), (3,), COORDINATE, f"{key} in {path}")
        for key in ("min", "max", "centroid")
    )
    count = as_count(values.get("numVertices"), 0, MAX_VERTICES, f"numVertices in {path}")
    return ModelFacts(count, low, high, centroid)


def copy_model(root: Path, catid: str, model_id: str, output_root: Path) -> Path:
    """Copy a model to ``output_root/<catid>/<id>/models`` as ShapeNetCore v2 has it, and return that folder.

    Mesh, materials, facts and solid voxels are copied (the last three if they exist), textures are not. Files
    of v2 are copied as they are; a model of v1 is rotated and normalised. A folder that exists is left as it
    is, and it appears only when it is whole, so several processes may copy the same model.

    Raises:
        DataError: the mesh is missing, damaged or without faces.
    """
    path, version = _mesh_of(root, catid, model_id)
    folder = output_root / catid / model_id / "models"
    if folder.is_dir():
        return folder
    vertices, _ = read_obj(path)
    with finished_folder(folder) as files:
        if version == "v1":
            _convert_v1(path, vertices, model_id, files)
        elif version == "boxed":
            shutil.copyfile(path, files / path.name)
        else:
            for ending in ("obj", "mtl", "json", "solid.binvox"):
                source = path.with_name(f"{STEM}.{ending}")
                if source.is_file():
                    shutil.copyfile(source, files / source.name)
    return folder


def _mesh_of(root: Path, catid: str, model_id: str) -> tuple[Path, Version]:
    mesh = _find_mesh(root, catid, model_id)
    if mesh is None:
        raise DataError(
            f"no CAD model {catid}/{model_id} in {root}; "
            "give the folder of ShapeNetCore that holds it, or add it there"
        )
    return mesh


def _find_mesh(root: Path, catid: str, model_id: str) -> tuple[Path, Version] | None:
    # Names come from annotation files: one like "../.." must not lead out of the folder.
    if not (_NAME.fullmatch(catid) and _NAME.fullmatch(model_id)):
        return None
    for nest in _NESTS:
        mesh = _mesh_below(root / nest / catid / model_id)
        if mesh is not None:
            return mesh
    return None


def _mesh_below(model: Path) -> tuple[Path, Version] | None:
    return next(((model / name, version) for name, version in _MESHES if (model / name).is_file()), None)


def _facts_of_v1(path: Path, vertices: NDArray[np.float64]) -> ModelFacts:
    turned = vertices @ V2_FROM_V1.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    if not np.linalg.norm(high - low) > _LEAST_DIAGONAL:
        raise DataError(f"the CAD model {path} has all its vertices in one point; restore the file")
    return ModelFacts(len(turned), low, high, turned.mean(axis=0))


def _normalised(points: NDArray[np.float64], facts: ModelFacts) -> NDArray[np.float64]:
    """Return points of v1 in the frame of v2."""
    return (points @ V2_FROM_V1.T - facts.centroid) / np.linalg.norm(facts.high - facts.low)


def _convert_v1(path: Path, vertices: NDArray[np.float64], model_id: str, files: Path) -> None:
    """Write a model of v1 as v2 has it."""
    facts = _facts_of_v1(path, vertices)
    with (files / f"{STEM}.obj").open("wb") as file:
        for line in replaced_obj(path, _normalised(vertices, facts), V2_FROM_V1):
            file.write(f"mtllib {STEM}.mtl\n".encode() if line.startswith(b"mtllib ") else line)
    if path.with_suffix(".mtl").is_file():
        shutil.copyfile(path.with_suffix(".mtl"), files / f"{STEM}.mtl")
    values = {
        "id": model_id,
        "numVertices": facts.num_vertices,
        "min": facts.low.tolist(),
        "max": facts.high.tolist(),
        "centroid": facts.centroid.tolist(),
    }
    (files / f"{STEM}.json").write_text(json.dumps(values), encoding="ascii")
    solid = path.with_name("model.solid.binvox")
    if solid.is_file():
        _turn_voxels(solid, facts, files / f"{STEM}.solid.binvox")


def _turn_voxels(path: Path, facts: ModelFacts, output: Path) -> None:
    """Write the voxels of v1 in the frame of v2; damaged ones are not written, as training needs none."""
    try:
        cells, translate, scale = read_binvox(path)
    except DataError as error:
        _log.warning("left out: %s", error)
        return
    # The cube's lower corner after the rotation: z runs against the old x.
    low = np.array([translate[2], translate[1], -translate[0] - scale])
    diagonal = float(np.linalg.norm(facts.high - facts.low))
    turned = cells.transpose(2, 1, 0)[:, :, ::-1]
    write_binvox(output, turned, (low - facts.centroid) / diagonal, scale / diagonal)
