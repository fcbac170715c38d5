# SPDX-License-Identifier: Apache-2.0
"""How good the shapes of the objects are that were found: IoU of the grids and chamfer distance."""

from __future__ import annotations

import math
from typing import TypedDict

import torch
from torch import Tensor

from raytran.errors import ShapeError
from raytran.metrics.functional.alignment import SCAN2CAD_LIMITS, alignment_errors
from raytran.metrics.functional.detection import match_in_order, score_order
from raytran.metrics.functional.shape import chamfer_distance, grid_iou, surface_points
from raytran.metrics.per_scene import ObjectMetric, Row, SceneRecord
from raytran.structs import ObjectSet


class ClassShapes(TypedDict):
    """Means over the matched objects of one class, None if there are none."""

    n_matched: int
    iou: float | None
    chamfer_distance: float | None


class ShapeResult(ClassShapes):
    """What ``MatchedShapeScores.compute`` returns: means over all matched objects, and by class.

    Attributes:
        n_matched: objects compared.
        n_empty: those of them whose predicted shape is empty, with IoU 0 and without chamfer distance.
    """

    n_empty: int
    per_class: dict[str, ClassShapes]


class MatchedShapeScores(ObjectMetric):
    """Mean IoU and chamfer distance of the shapes of the objects that strict ``Scan2CADAccuracy`` finds.

    Both shapes are ``(S, S, S)`` grids over an object's own box; a cell is occupied where the predicted
    probability is above ½. The IoU compares cell by cell, axes stretched to a cube, which is what the shape
    head is trained for. For the chamfer distance both grids fill the *true* box, in metres: it is
    ½ (mean_a min_b |a - b| + mean_b min_a |a - b|) over the centres of the surface cells a and b. Neither
    counts errors of the pose, which the accuracy counts.

    Args:
        **kwargs: see ``ObjectMetric``.
    """

    # Label, whether it is matched, IoU and chamfer distance, NaN where there is none.
    truth_columns = 4
    prediction_columns = 0
    judges_shapes = True

    def judge(self, predictions: ObjectSet, targets: ObjectSet) -> tuple[Tensor, Tensor]:
        """Match one scene and compare the shapes of the pairs; see the base class.

        Raises:
            ShapeError: a set with objects has no shapes, or the grids differ in size.
        """
        table = torch.full((len(targets), self.truth_columns), torch.nan, dtype=torch.float64)
        table[:, 0], table[:, 1] = targets.label.double(), 0.0
        none = table.new_zeros(len(predictions), self.prediction_columns)
        if not len(predictions) or not len(targets):
            return table, none
        predicted, true = _occupied(predictions, targets)
        allowed = alignment_errors(predictions, targets).within(*SCAN2CAD_LIMITS)
        allowed &= predictions.label[:, None] == targets.label
        for taker, taken in enumerate(match_in_order(score_order(predictions.score), allowed).tolist()):
            if taken >= 0 and true[taken].any():
                size, shapes = targets.size[taken], (predicted[taker], true[taken])
                distance = chamfer_distance(*(surface_points(shape, size) for shape in shapes))
                table[taken, 1:] = table.new_tensor([1.0, grid_iou(*shapes), distance])
        return table, none

    def compute(self) -> ShapeResult:
        """Return the means over all matched objects and over those of each class."""
        truths = self.truths()
        matched = truths[truths[:, 1] == 1]
        per_class = {name: _means(matched[matched[:, 0] == k]) for k, name in enumerate(self.classes.names)}
        n_empty = int(matched[:, 3].isnan().sum())
        return ShapeResult(**_means(matched), n_empty=n_empty, per_class=per_class)

    def object_rows(self, record: SceneRecord) -> list[Row]:
        """Return IoU and chamfer distance of each object, None where it has no match."""
        return [
            {
                "scene_id": record.scene_id,
                "object": index,
                "category": self.classes.names[int(label)],
                "shape_iou": None if math.isnan(iou) else iou,
                "chamfer_distance_m": None if math.isnan(distance) else distance,
            }
            for index, (label, _, iou, distance) in enumerate(record.truths.tolist())
        ]

    def scene_row(self, record: SceneRecord) -> Row:
        """Return the means of one scene."""
        means = _means(record.truths[record.truths[:, 1] == 1])
        values: Row = {"shape_iou": means["iou"], "chamfer_distance_m": means["chamfer_distance"]}
        return {"scene_id": record.scene_id, **values}


def _occupied(predictions: ObjectSet, targets: ObjectSet) -> tuple[Tensor, Tensor]:
    if predictions.shape is None or targets.shape is None:
        raise ShapeError(
            "shapes cannot be compared: decode the predictions' and ask the data set for 'shapes'"
        )
    if predictions.shape.shape[1:] != targets.shape.shape[1:]:
        raise ShapeError(
            "expected predicted and true shape grids of one size, got "
            f"{tuple(predictions.shape.shape[1:])} and {tuple(targets.shape.shape[1:])}"
        )
    return predictions.shape > 0.5, targets.shape.bool()


def _means(matched: Tensor) -> ClassShapes:
    """Return the means over rows of the table, the same to the last bit in whatever order they come."""
    iou, distance = matched[:, 2].tolist(), [value for value in matched[:, 3].tolist() if value == value]
    return ClassShapes(
        n_matched=len(iou),
        iou=math.fsum(iou) / len(iou) if iou else None,
        chamfer_distance=math.fsum(distance) / len(distance) if distance else None,
    )
