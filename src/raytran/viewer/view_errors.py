# SPDX-License-Identifier: Apache-2.0
"""The errors of each predicted object, as the strict protocol of the Scan2CAD accuracy counts them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.metrics.functional.alignment import alignment_errors
from raytran.metrics.functional.detection import match_in_order, score_order
from raytran.structs import ObjectSet

LIMITS = (0.2, 20.0, 0.2)
"""Metres, degrees and ratio within which an object is found (Scan2CAD's benchmark)."""


def object_errors(predictions: ObjectSet, truth: ObjectSet) -> list[dict[str, Any] | None]:
    """Compare each predicted object with the true one that it found, else with the nearest of its class.

    Args:
        predictions: P objects.
        truth: M objects.

    Returns:
        for each prediction None if no true object has its class, else ``found`` (whether it counts, each true
        object once and the surer prediction first), ``truth`` (index of the true object), ``translation_m``,
        ``rotation_deg``, ``scale`` (ratio) and ``iou`` of the boxes.
    """
    if not len(truth):
        return [None] * len(predictions)
    predictions, truth = _double(predictions), _double(truth)
    errors = alignment_errors(predictions, truth)
    same_class = predictions.label[:, None] == truth.label
    found = match_in_order(score_order(predictions.score), same_class & errors.within(*LIMITS))
    nearest = torch.where(same_class, errors.translation, torch.inf).argmin(dim=1)
    compared = torch.where(found >= 0, found, nearest)
    iou = box_iou(_boxes(predictions), _boxes(truth))[0]

    def entry(index: int) -> dict[str, Any] | None:
        if not same_class[index].any():
            return None
        other = int(compared[index])
        return {
            "found": bool(found[index] >= 0),
            "truth": other,
            "translation_m": _number(errors.translation[index, other]),
            "rotation_deg": _number(errors.rotation[index, other]),
            "scale": _number(errors.scale[index, other]),
            "iou": _number(iou[index, other]),
        }

    return [entry(index) for index in range(len(predictions))]


def _number(value: Tensor) -> float:
    return round(float(value), 6)


def _double(objects: ObjectSet) -> ObjectSet:
    """Return the objects in float64: predictions and annotations come in different precisions."""
    center, size, rotation = objects.center.double(), objects.size.double(), objects.rotation.double()
    return replace(objects, center=center, size=size, rotation=rotation)


def _boxes(objects: ObjectSet) -> OrientedBoxes:
    return OrientedBoxes(objects.center, objects.size, objects.rotation)
