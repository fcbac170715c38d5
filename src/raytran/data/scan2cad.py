# SPDX-License-Identifier: Apache-2.0
"""Scan2CAD's ``full_annotations.json``: which CAD models stand where in a scan."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from raytran.classes import PAPER_CLASSES, Classes
from raytran.data.cache import file_digest
from raytran.data.text import as_name, read_json
from raytran.errors import DataError
from raytran.geometry.rotation import matrix_from_quaternion, quaternion_from_matrix
from raytran.limits import BOX_SIDE, CAD_SCALE, HALF_EXTENT, POSITION, QUATERNION, Quantity, as_numbers, shown
from raytran.structs import SYMMETRY_INFINITE, CadAlignments, ObjectSet

_log = logging.getLogger(__name__)

_SYMMETRY = {
    "__SYM_NONE": 1,
    "__SYM_ROTATE_UP_2": 2,
    "__SYM_ROTATE_UP_4": 4,
    "__SYM_ROTATE_UP_INF": SYMMETRY_INFINITE,
}

SMALLEST_SCALE = 1e-3
"""Models with a smaller scale along any axis are annotation errors (ODAM skips the same)."""

_LEAST_LENGTH = 1e-9
"""Of a quaternion: what is shorter has no direction left."""

_MIN_SIZE = 1e-3
"""Least size of a box, metres: a CAD model may be a flat sheet, and sizes are compared by their logarithm."""


@dataclass(frozen=True)
class SceneAnnotation:
    """The M CAD models of one scan, in the order of the file.

    Attributes:
        scene_id: name of the scan.
        model_id: ``catid/id`` of each model in ShapeNet.
        scan_from_cad: ``(M, 4, 4)`` float64, inv(M_scan) · T R S.
        box_center: ``(M, 3)`` float64, centre of the model's box in CAD coordinates.
        box_half_size: ``(M, 3)`` float64, half extents of that box.
        symmetry: ``(M,)`` int64, 1, 2, 4 or ``SYMMETRY_INFINITE``.
        scale: ``(M, 3)`` float64, S as annotated, of either sign.
    """

    scene_id: str
    model_id: tuple[str, ...]
    scan_from_cad: Tensor
    box_center: Tensor
    box_half_size: Tensor
    symmetry: Tensor
    scale: Tensor


def annotation_path(root: Path) -> Path:
    """Return where a data set laid out as ``root/{scannet,scan2cad,shapenet}`` has its annotation."""
    return Path(root) / "scan2cad" / "full_annotations.json"


def annotation_digest(root: Path) -> str | None:
    """Return a digest of a data set's annotation, which identifies the data set; None if it has none."""
    path = annotation_path(root)
    return file_digest(path) if path.is_file() else None


def read_annotations(path: Path) -> dict[str, SceneAnnotation]:
    """Read an annotation file.

    Args:
        path: ``full_annotations.json``.

    Returns:
        the scenes by name; scenes without models are among them.

    Raises:
        DataError: the file is missing, no JSON, or an entry lacks a field.
    """
    entries = read_entries(path)
    scenes: dict[str, SceneAnnotation] = {}
    for number, entry in enumerate(entries):
        try:
            scene = parse_entry(entry)
            if scene.scene_id in scenes:
                raise DataError(f"scene {shown(scene.scene_id)} occurs twice")
        except DataError as error:
            raise DataError(
                f"entry {number} of {path} is not as in Scan2CAD's full_annotations.json ({error}): "
                "copy the file again"
            ) from error
        scenes[scene.scene_id] = scene
    return scenes


def read_entries(path: Path) -> list[Any]:
    """Return the entries of an annotation file as they are.

    Raises:
        DataError: the file is missing, no JSON, or no list.
    """
    entries = read_json(Path(path))
    if not isinstance(entries, list):
        raise DataError(f"{path} is not a list of scenes as Scan2CAD's full_annotations.json: check the path")
    return entries


def parse_entry(entry: Any) -> SceneAnnotation:
    """Return one entry of an annotation file, checked.

    Raises:
        DataError: it lacks a field or holds something impossible; the message does not name the entry.
    """
    try:
        return _scene(entry)
    except KeyError as error:
        raise DataError(f"it has no field {shown(error.args[0])}") from error
    except (TypeError, AttributeError) as error:
        raise DataError("a list stands where an object belongs, or the other way round") from error
    except RuntimeError as error:
        raise DataError("the scan's trs cannot be inverted") from error


def scene_objects(annotation: SceneAnnotation, classes: Classes = PAPER_CLASSES) -> ObjectSet:
    """Return a scene's objects in the scan frame, the world of the scan's poses.

    With M = inv(M_scan) · T R S the centre is M · (box centre), the size the box times the lengths of M's
    columns, and the rotation M's columns at length one. Models with a scale below 1 mm a unit are left out.

    Args:
        annotation: one scene of ``read_annotations``.
        classes: that the models are of, by their category (``Classes.label_of``); those of no class are left
            out.

    Returns:
        M objects without shapes.
    """
    pose = annotation.scan_from_cad
    scale = pose[:, :3, :3].norm(dim=1)
    keep = (scale >= SMALLEST_SCALE).all(dim=1)
    if not keep.all():
        _log.warning("%s: skipped %d models with a degenerate scale", annotation.scene_id, int((~keep).sum()))
    labels = [classes.label_of(name.split("/")[0]) for name in annotation.model_id]
    keep &= torch.tensor([label is not None for label in labels], dtype=torch.bool)
    center = pose[:, :3, :3] @ annotation.box_center[..., None] + pose[:, :3, 3:]
    return ObjectSet(
        label=torch.tensor([-1 if label is None else label for label in labels], dtype=torch.int64),
        center=center[..., 0].float(),
        size=(2 * annotation.box_half_size * scale).clamp(min=_MIN_SIZE).float(),
        rotation=(pose[:, :3, :3] / scale[:, None]).float(),
        symmetry=annotation.symmetry,
        score=torch.ones(len(pose)),
        model_id=annotation.model_id,
        classes=classes,
    ).select(keep)


def scene_alignments(annotation: SceneAnnotation) -> CadAlignments:
    """Return all of a scene's models as annotated: what the published evaluation scripts compare with.

    ``scale`` are the lengths of the columns of inv(M_scan) · T R S, and ``quaternion`` is the rotation
    closest to the columns at length one. A model without volume has no quaternion: NaN.

    Args:
        annotation: one scene of ``read_annotations``.
    """
    pose = annotation.scan_from_cad
    scale = pose[:, :3, :3].norm(dim=1)
    names = [name.split("/", 1) for name in annotation.model_id]
    return CadAlignments(
        catid=tuple(catid for catid, _ in names),
        id_cad=tuple(id_cad for _, id_cad in names),
        translation=pose[:, :3, 3],
        quaternion=quaternion_from_matrix(pose[:, :3, :3] / scale[:, None]),
        scale=scale,
        score=torch.ones(len(pose), dtype=torch.float64),
        half_extent=annotation.box_half_size,
        center=annotation.box_center,
        symmetry=annotation.symmetry,
        pose=pose,
        annotated_scale=annotation.scale,
    )


def _scene(entry: dict[str, Any]) -> SceneAnnotation:
    models = entry["aligned_models"]
    if not isinstance(models, list):
        raise DataError("aligned_models is no list")
    scene = SceneAnnotation(
        scene_id=as_name(entry["id_scan"], "id_scan"),
        model_id=tuple(
            f"{as_name(model['catid_cad'], 'catid_cad')}/{as_name(model['id_cad'], 'id_cad')}"
            for model in models
        ),
        scan_from_cad=torch.linalg.inv(_matrices([entry["trs"]]))
        @ _matrices([model["trs"] for model in models]),
        box_center=_vectors(models, "center", 3, POSITION),
        box_half_size=_vectors(models, "bbox", 3, HALF_EXTENT),
        symmetry=torch.tensor([_symmetry(model["sym"]) for model in models], dtype=torch.int64),
        scale=_vectors([model["trs"] for model in models], "scale", 3, CAD_SCALE),
    )
    _check_boxes(scene)
    return scene


def _check_boxes(scene: SceneAnnotation) -> None:
    """Raise if numbers that can each be true make a box together that no room has."""
    pose = scene.scan_from_cad
    center = (pose[:, :3, :3] @ scene.box_center[..., None])[..., 0] + pose[:, :3, 3]
    size = 2 * scene.box_half_size * pose[:, :3, :3].norm(dim=1)
    within = (center.abs() <= POSITION.high).all(dim=1) & (size <= BOX_SIDE.high).all(dim=1)
    if not within.all():
        index = int((~within).nonzero()[0])
        raise DataError(f"the box of {shown(scene.model_id[index])} is kilometres large or away")


def _symmetry(name: Any) -> int:
    if not isinstance(name, str) or name not in _SYMMETRY:
        raise DataError(f"unknown symmetry {shown(name)}")
    return _SYMMETRY[name]


def _matrices(trs: Sequence[dict[str, Any]]) -> Tensor:
    """Return T · R · S of each entry, ``(M, 4, 4)`` float64; quaternions are [w, x, y, z]."""
    matrices = torch.eye(4, dtype=torch.float64).repeat(len(trs), 1, 1)
    quaternion = _vectors(trs, "rotation", 4, QUATERNION)
    if (quaternion.norm(dim=1) < _LEAST_LENGTH).any():
        raise DataError("a quaternion has length zero")
    rotation = matrix_from_quaternion(quaternion)
    matrices[:, :3, :3] = rotation * _vectors(trs, "scale", 3, CAD_SCALE)[:, None]
    matrices[:, :3, 3] = _vectors(trs, "translation", 3, POSITION)
    return matrices


def _vectors(entries: Sequence[dict[str, Any]], key: str, length: int, quantity: Quantity) -> Tensor:
    """Return the numbers that each entry has under a key, ``(M, length)`` float64."""
    rows = [entry[key] for entry in entries]
    return torch.from_numpy(as_numbers(rows, (len(rows), length), quantity, key))
