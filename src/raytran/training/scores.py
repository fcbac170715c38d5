# SPDX-License-Identifier: Apache-2.0
"""The metrics that apply to what a model was asked for, updated and computed together."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal

import torch
from torch import nn
from torchmetrics import Metric

from raytran.classes import PAPER_CLASSES, Classes
from raytran.heads.score_scaling import SCORE_THRESHOLD
from raytran.metrics.average_precision import MeanAveragePrecision, threshold_name
from raytran.metrics.box_f1 import OrientedBoxF1
from raytran.metrics.new_views import NewViewScores
from raytran.metrics.occupancy_iou import ForegroundIoU, SceneOccupancyIoU
from raytran.metrics.per_scene import Row
from raytran.metrics.score_calibration import ScoreCalibration
from raytran.metrics.shape import MatchedShapeScores
from raytran.metrics.strict import StrictScores, side_by_side
from raytran.postprocess import DUPLICATE_IOU, select_objects
from raytran.structs import ObjectSet, SceneBatch, ScenePrediction

_OF_ALL_SCORES = ("best", "average_precision", "mean_average_precision")
"""What only predictions of every score can tell."""


class SceneScores(nn.Module):
    """Alignment accuracy, box F1 and shapes of objects, IoU of occupancy and masks, PSNR of new views.

    Args:
        tasks: what the model predicts: ``objects``, ``occupancy``, ``foreground``, ``shape``, ``view``.
        score_threshold: objects with a lower score do not count as predicted.
        duplicate_iou: nor does one that overlaps a surer one of its class by more than this IoU.
        volume_extent: size of the voxel grid, metres; given, the results also tell why objects are missed
            (``ErrorAtlas``), how many would be found at other thresholds (``AccuracyCurves``), and whether
            scores mean what they say (``ScoreCalibration``).
        map_boxes: with the mean average precision of boxes that are ``oriented`` or ``axis_aligned``
            (``MeanAveragePrecision``), of predictions of every score; None: without.
        metrics: further ones by name, e.g. of your own: ``update(batch, predictions)`` gets what ``update``
            here gets, objects of every score among it, and ``compute()`` returns one number. None for none.
        classes: of the objects.
    """

    def __init__(
        self,
        *,
        tasks: Collection[str],
        score_threshold: float = SCORE_THRESHOLD,
        duplicate_iou: float | None = DUPLICATE_IOU,
        volume_extent: Sequence[float] | None = None,
        map_boxes: str | None = None,
        metrics: Mapping[str, Metric] | None = None,
        classes: Classes = PAPER_CLASSES,
    ) -> None:
        super().__init__()
        self._score_threshold = score_threshold
        self._duplicate_iou = duplicate_iou
        self.strict = self.box_f1_of_all = self.mean_average_precision = None
        self.calibration = self.calibration_of_all = None
        if "objects" in tasks:
            self.strict = StrictScores(
                explain=volume_extent is not None, volume_extent=volume_extent, classes=classes
            )
            # Predictions of every score, to tell which threshold would have been the best.
            self.box_f1_of_all = OrientedBoxF1(classes=classes)
            if volume_extent is not None:
                self.calibration = ScoreCalibration(classes=classes)
                self.calibration_of_all = ScoreCalibration(classes=classes)
            if map_boxes is not None:
                self.mean_average_precision = MeanAveragePrecision(boxes=map_boxes, classes=classes)
        self.shape = MatchedShapeScores(classes=classes) if "shape" in tasks else None
        self.occupancy = SceneOccupancyIoU() if "occupancy" in tasks else None
        self.foreground = ForegroundIoU() if "foreground" in tasks else None
        self.new_views = NewViewScores() if "view" in tasks else None
        self.metrics: Any = nn.ModuleDict(metrics or {})

    def update(self, batch: SceneBatch, predictions: Sequence[ScenePrediction]) -> None:
        """Add scenes; a metric whose targets the batch lacks is left as it is."""
        if self.strict is not None and self.box_f1_of_all is not None and batch.objects is not None:
            counted = self._objects(predictions, self._score_threshold)
            self.strict.update(counted, batch.objects, batch.scene_id, list(batch.grid_center))
            every = self._objects(predictions, 0.0)
            self.box_f1_of_all.update(every, batch.objects, batch.scene_id)
            if self.calibration is not None and self.calibration_of_all is not None:
                self.calibration.update(counted, batch.objects, batch.scene_id)
                self.calibration_of_all.update(every, batch.objects, batch.scene_id)
            if self.mean_average_precision is not None:
                self.mean_average_precision.update(every, batch.objects, batch.scene_id)
        for index, prediction in enumerate(predictions):
            names = [batch.scene_id[index]]
            occupancy, foreground = prediction.occupancy, prediction.foreground
            if self.occupancy is not None and batch.occupancy is not None and occupancy is not None:
                self.occupancy.update(occupancy[None], batch.occupancy[index, None], names)
            if self.foreground is not None and batch.foreground is not None and foreground is not None:
                self.foreground.update(foreground[None], batch.foreground[index, None], names)
        rendered = [p.new_views for p in predictions if p.new_views is not None]
        if self.new_views is not None and batch.new_views is not None and len(rendered) == len(predictions):
            self.new_views.update(torch.stack(rendered), batch.new_views, batch.views, batch.scene_id)
        for metric in self.metrics.values():
            metric.update(batch, predictions)

    def update_shapes(self, batch: SceneBatch, predictions: Sequence[ScenePrediction]) -> None:
        """Add the shapes of scenes; apart from ``update``, since decoding them for every query is dear.

        Args:
            batch: scenes whose objects have shapes.
            predictions: with shapes for at least the objects that count as predicted.
        """
        if self.shape is not None and batch.objects is not None:
            counted = self._objects(predictions, self._score_threshold)
            self.shape.update(counted, batch.objects, batch.scene_id)

    def _objects(self, predictions: Sequence[ScenePrediction], score_threshold: float) -> list[ObjectSet]:
        """Return the objects of each scene that count at a threshold."""
        return [
            select_objects(p, score_threshold=score_threshold, duplicate_iou=self._duplicate_iou).objects
            for p in predictions
        ]

    def results(self) -> dict[str, Any]:
        """Return everything the metrics say in the layout of ``metrics.json``; every rank must call it."""
        results: dict[str, Any] = {}
        if self.strict is not None and self.box_f1_of_all is not None:
            results["strict"] = self.strict.compute()
            for threshold, scores in self.box_f1_of_all.compute()["per_threshold"].items():
                of_threshold = results["strict"]["per_threshold"][threshold]
                of_threshold |= {name: value for name, value in scores.items() if name in _OF_ALL_SCORES}
        if self.calibration is not None and self.calibration_of_all is not None:
            results["strict"]["calibration"] = {
                "counted": self.calibration.compute(),
                "every_score": self.calibration_of_all.compute(),
            }
        if self.mean_average_precision is not None:
            results["map"] = self.mean_average_precision.compute()
        if self.occupancy is not None:
            results["occupancy_iou"] = self.occupancy.compute().item()
        if self.foreground is not None:
            results["foreground_iou"] = self.foreground.compute().item()
        if self.shape is not None:
            results["shape"] = self.shape.compute()
        if self.new_views is not None:
            results["new_views"] = self.new_views.compute()
        return results | {name: float(metric.compute()) for name, metric in self.metrics.items()}

    def compute(self) -> dict[str, float]:
        """Return the numbers to watch during training: ``task/number``, ``task/number/class``.

        Classes are those of the true objects.
        """
        results = self.results()
        numbers: dict[str, float] = {}
        if "strict" in results:
            strict = results["strict"]
            numbers["objects/accuracy_global"] = strict["global_average"]
            numbers["objects/accuracy_class"] = strict["class_average"]
            for name, entry in strict["per_class"].items():
                if entry["n_total"]:
                    numbers[f"objects/accuracy/{name}"] = entry["accuracy"]
            for threshold, values in strict["per_threshold"].items():
                numbers[f"objects/f1_{threshold}"] = values["f1"]
                for name, entry in values["per_class"].items():
                    if entry["n_true"]:
                        numbers[f"objects/f1_{threshold}/{name}"] = entry["f1"]
        if self.mean_average_precision is not None:
            for threshold in self.mean_average_precision.iou_thresholds:
                of_threshold = results["map"][threshold_name(threshold)]
                numbers[f"objects/map_{threshold:g}"] = of_threshold["mean"]
                for name, value in of_threshold["per_class"].items():
                    numbers[f"objects/map_{threshold:g}/{name}"] = value
        for task in ("occupancy", "foreground"):
            if f"{task}_iou" in results:
                numbers[f"{task}/iou"] = results[f"{task}_iou"]
        for name, value in results.get("new_views", {}).items():
            if name != "n_views":
                numbers[f"view/{name}"] = value
        return numbers | {name: results[name] for name in self.metrics}

    def rows(self, per: Literal["scene", "object"]) -> list[Row]:
        """Return a row for each scene or true object, the columns of the object metrics side by side."""
        if self.strict is None:
            return []
        rows = side_by_side(per, self.strict.accuracy, self.strict.box_f1, self.shape, self.strict.atlas)
        if self.mean_average_precision is None:
            return rows
        of_map = self.mean_average_precision.rows(per)
        return [
            {**row, **{f"map_{name}": value for name, value in other.items() if "matched" in name}}
            for row, other in zip(rows, of_map, strict=True)
        ]

    def new_view_rows(self) -> list[Row]:
        """Return a row for each new view."""
        return [] if self.new_views is None else self.new_views.rows()

    def reset(self) -> None:
        """Forget all scenes."""
        objects = (self.strict, self.box_f1_of_all, self.mean_average_precision, self.shape)
        calibration = (self.calibration, self.calibration_of_all)
        others = (self.occupancy, self.foreground, self.new_views, *self.metrics.values())
        for metric in (*objects, *calibration, *others):
            if metric is not None:
                metric.reset()
