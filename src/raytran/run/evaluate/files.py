# SPDX-License-Identifier: Apache-2.0
"""Predictions of many scenes from files that anybody may have written."""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from raytran.errors import DataError
from raytran.export.alignments import align_cads
from raytran.export.scan2cad_csv import ALIGNMENTS, read_alignments_csv, read_roca_csv
from raytran.export.scene_json import read_scene_json
from raytran.geometry.rotation import matrix_from_quaternion
from raytran.structs import CLASS_BY_CATID, CLASSES, CadAlignments, ObjectSet

_log = logging.getLogger(__name__)

_THINNEST = 1e-3
"""Least size of a box, metres, as of annotated objects: a CAD model may be a flat sheet."""

_NOT_ORTHOGONAL = 1e-3
"""Largest entry of ``RᵀR - 1`` of a matrix that still counts as a rotation."""

CadBoxes = Mapping[str, tuple[Tensor, Tensor]]
"""Centre and half extents ``(3,)`` of each annotated CAD model's box in CAD units, by ``catid/id``."""


@dataclass(frozen=True)
class ScenePredictions:
    """What was predicted for one scene, in the forms that the protocols compare.

    Attributes:
        path: the file.
        objects: boxes, for protocol ``strict``.
        boxes: for ``odam``, on the origins of the CAD models where these are known; those of CAD alignments
            get their size from the annotations.
        cads: CAD alignments in the order of the file, for ``scan2cad`` and ``vid2cad``; None if the file has
            objects without CAD models.
        n_unknown_cads: predictions left out of some of these, since the annotations do not know the box of
            their CAD model.
    """

    path: Path
    objects: ObjectSet
    boxes: CadAlignments
    cads: CadAlignments | None
    n_unknown_cads: int = 0


@dataclass(frozen=True)
class PredictionFiles:
    """The predictions by scene, and the names of those that were ignored as they are not asked for."""

    scenes: dict[str, ScenePredictions]
    ignored: tuple[str, ...]

    def counts(self) -> dict[str, int]:
        """Return what was read and what was left out, for ``metrics.json``."""
        return {
            "n_scenes_with_predictions": len(self.scenes),
            "n_scenes_ignored": len(self.ignored),
            "n_predictions_without_known_cad": sum(scene.n_unknown_cads for scene in self.scenes.values()),
        }


def read_predictions(path: Path, scene_ids: Collection[str], cad_boxes: CadBoxes) -> PredictionFiles:
    """Read the predictions for the scenes asked for.

    Args:
        path: a folder of ``<scene_id>.json`` or ``<scene_id>/scene.json`` (``raytran.scene/1``) or
            ``<scene_id>.csv`` (Scan2CAD, 12 columns); or the folder of one scene, with its ``scene.json``;
            or a CSV of ROCA's 14 columns with all scenes.
        scene_ids: the annotated scenes; others are ignored, without being opened.
        cad_boxes: of the CAD models that the annotations name.

    Raises:
        DataError: nothing there is for any of the scenes, a scene occurs twice, or a file is damaged.
    """
    if path.is_file():
        alignments = read_roca_csv(path)
        found = {name: _from_alignments(path, value, cad_boxes) for name, value in alignments.items()}
        scenes = {name: value for name, value in found.items() if name in scene_ids}
        ignored = tuple(found.keys() - scenes.keys())
    else:
        files = _files_by_scene(path)
        ignored = tuple(name for name in files if name not in scene_ids)
        scenes = {name: _read(files[name], name, cad_boxes) for name in files if name in scene_ids}
    if not scenes:
        raise DataError(
            f"{path} holds no predictions for any of the {len(scene_ids)} annotated scenes: name the files "
            "<scene_id>.json (raytran.scene/1) or <scene_id>.csv (12 columns)"
        )
    if ignored:
        shown = ", ".join(sorted(ignored)[:3]) + (", …" if len(ignored) > 3 else "")
        _log.warning("%s: ignored %d scenes that are not asked for (%s)", path, len(ignored), shown)
    result = PredictionFiles(scenes, ignored)
    if unknown := result.counts()["n_predictions_without_known_cad"]:
        _log.warning(
            "%s: the annotations do not know the CAD model of %d predictions: where its box is needed "
            "(strict and odam for a CSV, scan2cad and vid2cad for a JSON file), they find nothing",
            path,
            unknown,
        )
    return result


def _files_by_scene(folder: Path) -> dict[str, Path]:
    """Return the file of each scene in a folder, by name."""
    if not folder.is_dir():
        raise DataError(f"no predictions at {folder}: give a folder, or a CSV with all scenes")
    files: dict[str, Path] = {}
    for entry in sorted(folder.iterdir()):
        path = entry / "scene.json" if entry.is_dir() else entry
        if entry.name.startswith(".") or path.suffix not in (".json", ".csv") or not path.is_file():
            continue
        if entry.name == ALIGNMENTS:  # raytran.predict writes it beside a scene.json of the same objects
            continue
        name = entry.name if entry.is_dir() else entry.stem
        if entry.name == "scene.json":  # the folder is one that raytran.predict has written for one scene
            name = read_scene_json(entry).scene_id
        if name in files:
            raise DataError(f"{files[name]} and {path} both hold scene {name}: delete one of them")
        files[name] = path
    return files


def _read(path: Path, scene_id: str, cad_boxes: CadBoxes) -> ScenePredictions:
    if path.suffix == ".csv":
        return _from_alignments(path, read_alignments_csv(path), cad_boxes)
    prediction = read_scene_json(path)
    if prediction.scene_id not in (scene_id, ""):
        raise DataError(
            f"{path} says that it is scene {prediction.scene_id!r}, but its name says {scene_id!r}: rename it"
        )
    _check_objects(prediction.objects, path)
    return _from_objects(path, prediction.objects, cad_boxes)


def _check_objects(objects: ObjectSet, path: Path) -> None:
    """Raise on an object that nothing can be compared with, naming its line."""
    identity = torch.eye(3, dtype=torch.float64)
    skew = (objects.rotation.mT @ objects.rotation - identity).abs().amax(dim=(-2, -1))
    numbers = [objects.center, objects.size, objects.rotation.flatten(1), objects.score[:, None]]
    faults = {
        "a number is not finite": ~torch.cat(numbers, dim=1).isfinite().all(dim=1),
        "a size is not positive": (objects.size <= 0).any(dim=1),
        "the rotation is no rotation matrix": (skew > _NOT_ORTHOGONAL)
        | (torch.linalg.det(objects.rotation.nan_to_num()) <= 0),
    }
    for fault, where in faults.items():
        if where.any():
            index = int(where.nonzero()[0])
            raise DataError(f"{path}, line {_line_of_object(path, index)}: {fault}, mend object {index}")


def _line_of_object(path: Path, index: int) -> int:
    """Return the line on which an object's ``category`` stands: JSON parsers do not keep lines."""
    text = path.read_text(encoding="utf-8")
    starts = [match.start() for match in re.finditer(r'"category"\s*:', text)]
    return text.count("\n", 0, starts[index]) + 1


def _from_alignments(path: Path, cads: CadAlignments, cad_boxes: CadBoxes) -> ScenePredictions:
    """Turn CAD alignments into boxes, as far as the CAD models are known."""
    known = torch.tensor([i for i, name in enumerate(cads.model_id) if name in cad_boxes], dtype=torch.int64)
    chosen = cads.select(known)
    rotation = matrix_from_quaternion(chosen.quaternion)
    center, half = _lookup(chosen.model_id, cad_boxes)
    objects = ObjectSet(
        label=torch.tensor([CLASSES.index(name) for name in chosen.category], dtype=torch.int64),
        center=chosen.translation + (rotation @ (chosen.scale * center)[..., None])[..., 0],
        size=(2 * half * chosen.scale).clamp(min=_THINNEST),
        rotation=rotation,
        symmetry=torch.ones(len(chosen), dtype=torch.int64),
        score=chosen.score,
        model_id=chosen.model_id,
    )
    return ScenePredictions(path, objects, cads, cads, n_unknown_cads=len(cads) - len(known))


def _from_objects(path: Path, objects: ObjectSet, cad_boxes: CadBoxes) -> ScenePredictions:
    """Find the CAD alignments that boxes with the names of CAD models stand for."""
    names = objects.model_id or ("",) * len(objects)
    known = [name in cad_boxes and bool((cad_boxes[name][1] > 0).all()) for name in names]
    center, half = _lookup([name if ok else "" for name, ok in zip(names, known, strict=True)], cad_boxes)
    catid_of = {category: catid for catid, category in CLASS_BY_CATID.items()}
    parts = [name.partition("/") for name in names]
    catids = [
        part[0] or catid_of.get(CLASSES[label], "")
        for part, label in zip(parts, objects.label.tolist(), strict=True)
    ]
    boxes = align_cads(objects, catids, [part[2] for part in parts], center=center, half_extent=half)
    complete = all(names)
    index = torch.tensor(known, dtype=torch.bool).nonzero().squeeze(1)
    cads = replace(boxes.select(index), half_extent=None) if complete else None
    n_unknown = len(objects) - len(index) if complete else 0
    return ScenePredictions(path, objects, boxes, cads, n_unknown)


def _lookup(names: Collection[str], cad_boxes: CadBoxes) -> tuple[Tensor, Tensor]:
    """Return centres and half extents, ``(M, 3)`` each; those of a name that is unknown are 0 and 1/2."""
    unit = (torch.zeros(3, dtype=torch.float64), torch.full((3,), 0.5, dtype=torch.float64))
    found = [cad_boxes.get(name, unit) for name in names]
    if not found:
        return torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64)
    return torch.stack([center for center, _ in found]), torch.stack([half for _, half in found])
