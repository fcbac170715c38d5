# SPDX-License-Identifier: Apache-2.0
"""Scan2CAD's ``full_annotations.json``: which CAD models stand where in a scan."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from raytran.data.cache import file_digest
from raytran.errors import DataError
from raytran.geometry.rotation import matrix_from_quaternion, quaternion_from_matrix
from raytran.structs import CLASS_BY_CATID, CLASSES, SYMMETRY_INFINITE, CadAlignments, ObjectSet

_log = logging.getLogger(__name__)

_SYMMETRY = {
    "__SYM_NONE": 1,
    "__SYM_ROTATE_UP_2": 2,
    "__SYM_ROTATE_UP_4": 4,
    "__SYM_ROTATE_UP_INF": SYMMETRY_INFINITE,
}

SMALLEST_SCALE = 1e-3
"""Models with a smaller scale along any axis are annotation errors (ODAM skips the same)."""

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
                raise DataError(f"scene {scene.scene_id} occurs twice")
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
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"cannot read the annotations {path} ({error.strerror}): check the path") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is not valid JSON ({error}): copy it again") from error
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
        raise DataError(f"it has no field {error}") from error
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise DataError(f"{type(error).__name__}: {error}") from error


def scene_objects(annotation: SceneAnnotation) -> ObjectSet:
    """Return a scene's objects in the scan frame, the world of the scan's poses.

    With M = inv(M_scan) · T R S the centre is M · (box centre), the size the box times the lengths of M's
    columns, and the rotation M's columns at length one. Models with a scale below 1 mm a unit are left out.

    Args:
        annotation: one scene of ``read_annotations``.

    Returns:
        M objects without shapes.
    """
    pose = annotation.scan_from_cad
    scale = pose[:, :3, :3].norm(dim=1)
    keep = (scale >= SMALLEST_SCALE).all(dim=1)
    if not keep.all():
        _log.warning("%s: skipped %d models with a degenerate scale", annotation.scene_id, int((~keep).sum()))
    classes = [CLASS_BY_CATID.get(name.split("/")[0], "other") for name in annotation.model_id]
    center = pose[:, :3, :3] @ annotation.box_center[..., None] + pose[:, :3, 3:]
    return ObjectSet(
        label=torch.tensor([CLASSES.index(name) for name in classes], dtype=torch.int64),
        center=center[..., 0].float(),
        size=(2 * annotation.box_half_size * scale).clamp(min=_MIN_SIZE).float(),
        rotation=(pose[:, :3, :3] / scale[:, None]).float(),
        symmetry=annotation.symmetry,
        score=torch.ones(len(pose)),
        model_id=annotation.model_id,
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
    return SceneAnnotation(
        scene_id=str(entry["id_scan"]),
        model_id=tuple(f"{model['catid_cad']}/{model['id_cad']}" for model in models),
        scan_from_cad=torch.linalg.inv(_matrices([entry["trs"]]))
        @ _matrices([model["trs"] for model in models]),
        box_center=_vectors([model["center"] for model in models], 3),
        box_half_size=_vectors([model["bbox"] for model in models], 3),
        symmetry=torch.tensor([_symmetry(model["sym"]) for model in models], dtype=torch.int64),
        scale=_vectors([model["trs"]["scale"] for model in models], 3),
    )


def _symmetry(name: str) -> int:
    if name not in _SYMMETRY:
        raise ValueError(f"unknown symmetry {name!r}")
    return _SYMMETRY[name]


def _matrices(trs: Sequence[dict[str, Sequence[float]]]) -> Tensor:
    """Return T · R · S of each entry, ``(M, 4, 4)`` float64; quaternions are [w, x, y, z]."""
    matrices = torch.eye(4, dtype=torch.float64).repeat(len(trs), 1, 1)
    quaternion = _vectors([entry["rotation"] for entry in trs], 4)
    if (quaternion == 0).all(dim=1).any():
        raise ValueError("a quaternion has length zero")
    rotation = matrix_from_quaternion(quaternion)
    matrices[:, :3, :3] = rotation * _vectors([entry["scale"] for entry in trs], 3)[:, None]
    matrices[:, :3, 3] = _vectors([entry["translation"] for entry in trs], 3)
    return matrices


def _vectors(rows: Sequence[Sequence[float]], length: int) -> Tensor:
    vectors = torch.tensor(rows, dtype=torch.float64).reshape(len(rows), length)
    if not vectors.isfinite().all():
        raise ValueError("a number is not finite")
    return vectors
