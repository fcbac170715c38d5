# SPDX-License-Identifier: Apache-2.0
"""The true objects of a scene, and the errors of the predicted ones by Scan2CAD's strict protocol."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from raytran.classes import PAPER_CLASSES, Classes
from raytran.data.scan2cad import read_annotations, scene_objects
from raytran.errors import DataError
from raytran.export import FORMAT, read_scene_json
from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.metrics.functional.alignment import alignment_errors
from raytran.metrics.functional.detection import match_in_order, score_order
from raytran.structs import ObjectSet

LIMITS = (0.2, 20.0, 0.2)
"""Metres, degrees and ratio within which an object is found (Scan2CAD's benchmark)."""


@dataclass(frozen=True)
class ObjectError:
    """How far a predicted object is from a true one.

    Attributes:
        found: whether it counts: within ``LIMITS``, each true object once and the surer prediction first.
        truth: number of the true object.
        translation: distance of the centres, metres.
        rotation: angle, degrees, the least over the true object's symmetries.
        scale: error of the size, ratio.
        iou: of the boxes.
    """

    found: bool
    truth: int
    translation: float
    rotation: float
    scale: float
    iou: float


def object_errors(predictions: ObjectSet, truth: ObjectSet) -> list[ObjectError | None]:
    """Compare each predicted object with the true one that it found, else with the nearest of its class.

    Args:
        predictions: P objects.
        truth: M objects.

    Returns:
        one for each prediction; None if no true object has its class.
    """
    if not len(truth):
        return [None] * len(predictions)
    predictions, truth = _double(predictions), _double(truth)
    errors = alignment_errors(predictions, truth)
    same_class = predictions.label[:, None] == truth.label
    found = match_in_order(score_order(predictions.score), same_class & errors.within(*LIMITS))
    nearest = torch.where(same_class, errors.translation, torch.inf).argmin(dim=1)
    compared = torch.where(found >= 0, found, nearest).tolist()
    iou = box_iou(_boxes(predictions), _boxes(truth))[0]
    return [
        ObjectError(
            found=bool(found[index] >= 0),
            truth=other,
            translation=float(errors.translation[index, other]),
            rotation=float(errors.rotation[index, other]),
            scale=float(errors.scale[index, other]),
            iou=float(iou[index, other]),
        )
        if same_class[index].any()
        else None
        for index, other in enumerate(compared)
    ]


def read_truth(path: Path, scene_id: str, classes: Classes = PAPER_CLASSES) -> ObjectSet:
    """Read the true objects of one scene.

    Args:
        path: Scan2CAD's ``full_annotations.json``, or a file in the form of ``scene.json``.
        scene_id: name of the scene, by which it is found in the former.
        classes: that the objects are of; objects of no class are left out.

    Raises:
        DataError: the file cannot be read, is of neither form, or does not have the scene.
    """
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            beginning = file.read(200)
    except OSError as error:
        raise DataError(f"cannot read truth={path} ({error.strerror}): check the path") from error
    if FORMAT in beginning:
        return read_scene_json(path, classes).objects
    annotations = read_annotations(path)
    if scene_id not in annotations:
        raise DataError(f"{path} has no scene {scene_id}: give the annotations of this scene as truth=")
    return scene_objects(annotations[scene_id], classes)


def _double(objects: ObjectSet) -> ObjectSet:
    """Return the objects in float64: predictions and annotations come in different precisions."""
    center, size, rotation = objects.center.double(), objects.size.double(), objects.rotation.double()
    return replace(objects, center=center, size=size, rotation=rotation)


def _boxes(objects: ObjectSet) -> OrientedBoxes:
    return OrientedBoxes(objects.center, objects.size, objects.rotation)
