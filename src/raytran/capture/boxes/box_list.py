# SPDX-License-Identifier: Apache-2.0
"""Lists of boxes: ``boxes.json``, in the form of the ``scene.json`` that ``predict`` writes, or simpler."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.boxes.categories import Categories
from raytran.capture.names import path_inside
from raytran.data.cache import file_digest
from raytran.data.prepare.boxed_mesh import Mesh
from raytran.data.prepare.boxed_objects import BoxedObjects, as_symmetry, moved_mesh
from raytran.data.scannet.find import SPLITS
from raytran.data.targets import scan_surface
from raytran.data.text import read_json
from raytran.errors import DataError
from raytran.geometry.rotation import rotation_from_yaw, yaw_from_rotation
from raytran.limits import ANGLE, MATRIX_ENTRY, POSITION, Quantity, as_number, as_numbers, shown

FORMAT = "raytran.scene/1"
"""Of predicted scenes: their boxes are in metres, in the world with +z up that the scan's reader makes."""

CAPTURE_SETTINGS = ("format", "intrinsics", "up", "scale", "convention", "check")
"""What a list may say of the capture, named as ``predict`` names it."""

_KEYS = ("format", "scene_id", "up", "unit", "objects", "split", "mesh", "capture")
_ANY_SIDE = Quantity("a length", -1e6, 1e6)
_LEAST_SIDE = 1e-3
_YAWS_AGREE = math.radians(1.0)
_RIGID = 0.01
"""Error of a rotation's products up to which it is one, written with few digits."""


@dataclass(frozen=True)
class BoxList:
    """What a list says, unchecked but for its outer form.

    Attributes:
        path: the file.
        objects: its entries.
        split: that the capture belongs to; None: any.
        mesh: file of the scan's mesh, relative to the list; None: it names none.
        capture: settings of the capture, by ``CAPTURE_SETTINGS``.
        is_prediction: whether it has the form of a predicted scene.
        is_upright: whether its boxes are in the world that the scan's reader makes, rather than that of the
            poses as stored.
    """

    path: Path
    objects: tuple[Mapping[str, Any], ...]
    split: str | None
    mesh: str | None
    capture: Mapping[str, Any]
    is_prediction: bool
    is_upright: bool


def read_box_list(path: Path) -> BoxList:
    """Read the outer form of a list.

    Args:
        path: a JSON file: a list of objects, or an object with ``objects`` and some of ``format``, ``up``,
            ``unit``, ``split``, ``mesh``, ``capture``.

    Raises:
        DataError: it cannot be read, or is no list of boxes.
    """
    content = read_json(path)
    content = {"objects": content} if isinstance(content, list) else content
    objects = content.get("objects") if isinstance(content, dict) else None
    if not isinstance(objects, list) or not all(isinstance(entry, dict) for entry in objects):
        raise DataError(f"{path} has no list of objects: write [{{category, center, size, yaw}}, …]")
    named, unit, up = (content.get(key) for key in ("format", "unit", "up"))
    unknown = sorted(set(content) - set(_KEYS))
    if named is None and unknown:
        raise DataError(f"{path} has the key {shown(unknown[0])}: known are {', '.join(_KEYS)}")
    if named not in (None, FORMAT):
        raise DataError(f"{path} has format {shown(named)}: write {FORMAT}, or leave it out")
    if unit not in (None, "m"):
        raise DataError(f"{path} has its boxes in {shown(unit)}: write them in metres, unit m")
    if up not in (None, "+z"):
        raise DataError(f"{path} has up {shown(up)}: leave it out for boxes in the world of the poses, or +z")
    split, mesh = content.get("split"), content.get("mesh")
    if split is not None and split not in SPLITS:
        raise DataError(f"{path} has split {shown(split)}: choose one of {', '.join(SPLITS)}")
    if mesh is not None and not isinstance(mesh, str):
        raise DataError(f"{path} has mesh {shown(mesh)}: give the name of a PLY file")
    return BoxList(
        path=path,
        objects=tuple(objects),
        split=split,
        mesh=mesh,
        capture=_capture_settings(content.get("capture"), path),
        is_prediction=named == FORMAT,
        is_upright=named == FORMAT or up == "+z",
    )


def _capture_settings(value: object, path: Path) -> Mapping[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict) or not set(value) <= set(CAPTURE_SETTINGS):
        raise DataError(
            f"{path} has capture {shown(value)}: give some of {', '.join(CAPTURE_SETTINGS)}, as to predict"
        )
    return value


def boxed_objects(
    listed: BoxList, categories: Categories, *, world_from_input: torch.Tensor | None, scan_mesh: Mesh | None
) -> BoxedObjects:
    """Return the objects of a list, in the world that the scan's reader makes.

    Args:
        listed: what was read.
        categories: which classes there are.
        world_from_input: ``(4, 4)`` to that world from that of the stored poses; None: they are the same.
        scan_mesh: of the whole scan, in the world of the stored poses; None: there is none.

    Raises:
        DataError: an entry is damaged, is of no class, has a side that is not positive, or there is none.
    """
    path = listed.path
    if not listed.objects:
        raise DataError(f"{path} lists no box: annotate the objects of the scan, or remove the file")
    names = [
        categories.class_of(entry.get("category"), f"object {i} in {path}")
        for i, entry in enumerate(listed.objects)
    ]
    kept = [i for i, name in enumerate(names) if name is not None]
    if not kept:
        raise DataError(f"{path} lists no box of the classes {categories.classes}: all were left out")
    entries = [listed.objects[i] for i in kept]
    where = [f"object {i} in {path}" for i in kept]
    noticed: dict[str, list[str]] = {}
    left_out = sorted(
        {str(e.get("category")) for e, n in zip(listed.objects, names, strict=True) if n is None}
    )
    if left_out:
        noticed["categories_left_out"] = left_out
    meshes, missing = _meshes(entries, path)
    if missing:
        noticed["meshes_missing"] = missing
    objects = BoxedObjects(
        named_in=str(path),
        category=tuple(name for name in names if name is not None),
        center=np.array([_vector(e, "center", POSITION, w) for e, w in zip(entries, where, strict=True)]),
        size=np.array([_size(e, w) for e, w in zip(entries, where, strict=True)]),
        rotation=np.array([_rotation(e, w) for e, w in zip(entries, where, strict=True)]),
        symmetry=tuple(
            as_symmetry(e.get("symmetry", 1), f"symmetry of {w}") for e, w in zip(entries, where, strict=True)
        ),
        mesh=meshes,
        own_meshes_first=not listed.is_prediction,
        noticed=noticed,
    )
    objects = objects if listed.is_upright else objects.moved(world_from_input)
    if scan_mesh is not None and world_from_input is not None:
        scan_mesh = moved_mesh(scan_mesh, world_from_input.double().numpy())
    return replace(objects, scan_mesh=scan_mesh)


def read_mesh_file(path: Path) -> Mesh:
    """Return vertices and faces of a mesh file.

    Raises:
        DataError: it cannot be read, or holds no triangles.
    """
    vertices, faces = scan_surface(path, file_digest(path))
    return np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)


def _meshes(entries: Sequence[Mapping[str, Any]], path: Path) -> tuple[tuple[Mesh | None, ...], list[str]]:
    """Return the mesh of each entry, None where it has none, and the names of those that are not there."""
    meshes: list[Mesh | None] = []
    missing: list[str] = []
    for entry in entries:
        name = entry.get("mesh")
        if name is None:
            meshes.append(None)
            continue
        if not isinstance(name, str):
            raise DataError(
                f"{path} has an object with mesh {shown(name)}: give the name of a PLY file, or null"
            )
        file = path_inside(path.parent, name, path)
        if not file.is_file():
            missing.append(name)
        meshes.append(read_mesh_file(file) if file.is_file() else None)
    return tuple(meshes), missing


def _vector(entry: Mapping[str, Any], key: str, quantity: Quantity, where: str) -> NDArray[np.float64]:
    if key not in entry:
        raise DataError(f"{where} has no {key}: give three numbers in metres")
    return as_numbers(entry[key], (3,), quantity, f"{key} of {where}")


def _size(entry: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    size = _vector(entry, "size", _ANY_SIDE, where)
    if size.min() < _LEAST_SIDE:
        raise DataError(
            f"{where} has a side of {size.min():g} m: give positive full lengths of width, height and depth"
        )
    return size


def _rotation(entry: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    """Return world_from_object from ``rotation``, ``yaw`` or neither: axis-aligned."""
    given, yaw = entry.get("rotation"), entry.get("yaw")
    of_yaw = None
    if yaw is not None or given is None:
        angle = as_number(0.0 if yaw is None else yaw, ANGLE, f"yaw of {where}")
        of_yaw = rotation_from_yaw(torch.tensor(angle, dtype=torch.float64)).numpy()
    if given is None:
        return np.asarray(of_yaw)
    rotation = as_numbers(given, (3, 3), MATRIX_ENTRY, f"rotation of {where}")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0:
        raise DataError(f"rotation of {where} is none: give a 3x3 world_from_object, or yaw alone")
    left, _, right = np.linalg.svd(rotation)
    rotation = left @ right
    if of_yaw is not None:
        apart = yaw_from_rotation(torch.from_numpy(rotation)) - as_number(yaw, ANGLE, f"yaw of {where}")
        if abs(math.remainder(float(apart), 2 * math.pi)) > _YAWS_AGREE:
            raise DataError(
                f"yaw and rotation of {where} differ: correct both, or leave out the one that is wrong"
            )
    return np.asarray(rotation)
