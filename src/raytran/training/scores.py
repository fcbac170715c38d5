# SPDX-License-Identifier: Apache-2.0
"""The metrics that apply to what a model was asked for, updated and computed together."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from typing import Any, Literal

import torch
from torch import nn
from torchmetrics import Metric

from raytran.metrics.accuracy_curves import AccuracyCurves
from raytran.metrics.box_f1 import OrientedBoxF1
from raytran.metrics.error_atlas import ErrorAtlas
from raytran.metrics.iou import ForegroundIoU, SceneOccupancyIoU
from raytran.metrics.new_views import NewViewScores
from raytran.metrics.per_scene import Row
from raytran.metrics.scan2cad import Scan2CADAccuracy
from raytran.metrics.shape import MatchedShapeScores
from raytran.postprocess import select_objects
from raytran.structs import ObjectSet, SceneBatch, ScenePrediction

SCORE_THRESHOLD = 0.5
DUPLICATE_IOU = 0.25

_OF_ALL_SCORES = ("best", "average_precision", "mean_average_precision")
"""What only predictions of every score can tell."""


class SceneScores(nn.Module):
    """Alignment accuracy, box F1 and shapes of objects, IoU of occupancy and masks, PSNR of new views.

    Args:
        tasks: what the model predicts: ``objects``, ``occupancy``, ``foreground``, ``shape``, ``view``.
        score_threshold: objects with a lower score do not count as predicted.
        duplicate_iou: nor does one that overlaps a surer one of its class by more than this IoU.
        volume_extent: size of the voxel grid, metres; given, the results also tell why objects are missed
            (``ErrorAtlas``) and how many would be found at other thresholds (``AccuracyCurves``).
    """

    def __init__(
        self,
        *,
        tasks: Collection[str],
        score_threshold: float = SCORE_THRESHOLD,
        duplicate_iou: float | None = DUPLICATE_IOU,
        volume_extent: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        self._select = partial(select_objects, duplicate_iou=duplicate_iou)
        self._score_threshold = score_threshold
        self.accuracy = Scan2CADAccuracy(protocol="strict") if "objects" in tasks else None
        self.box_f1 = OrientedBoxF1(protocol="strict") if "objects" in tasks else None
        # Sees predictions of every score, to tell which threshold would have been the best.
        self.box_f1_sweep = OrientedBoxF1(protocol="strict") if "objects" in tasks else None
        explain = "objects" in tasks and volume_extent is not None
        self.curves = AccuracyCurves() if explain else None
        self.atlas = ErrorAtlas(volume_extent=volume_extent) if explain else None
        self.shape = MatchedShapeScores() if "shape" in tasks else None
        self.occupancy = SceneOccupancyIoU() if "occupancy" in tasks else None
        self.foreground = ForegroundIoU() if "foreground" in tasks else None
        self.view = NewViewScores() if "view" in tasks else None

    def update(self, batch: SceneBatch, predictions: Sequence[ScenePrediction]) -> None:
        """Add scenes; a metric whose targets the batch lacks is left as it is."""
        if batch.objects is not None:
            self._update_objects(batch, batch.objects, predictions)
        for index, prediction in enumerate(predictions):
            names = [batch.scene_id[index]]
            if (
                self.occupancy is not None
                and batch.occupancy is not None
                and prediction.occupancy is not None
            ):
                self.occupancy.update(prediction.occupancy[None], batch.occupancy[index, None], names)
            if (
                self.foreground is not None
                and batch.foreground is not None
                and prediction.foreground is not None
            ):
                self.foreground.update(prediction.foreground[None], batch.foreground[index, None], names)
        rendered = [p.new_views for p in predictions if p.new_views is not None]
        if self.view is not None and batch.new_views is not None and len(rendered) == len(predictions):
            self.view.update(torch.stack(rendered), batch.new_views, batch.views, batch.scene_id)

    def _update_objects(
        self, batch: SceneBatch, targets: Sequence[ObjectSet], predictions: Sequence[ScenePrediction]
    ) -> None:
        if self.accuracy is None or self.box_f1 is None or self.box_f1_sweep is None:
            return
        kept = [self._select(p, score_threshold=self._score_threshold).objects for p in predictions]
        self.accuracy.update(kept, targets, batch.scene_id)
        self.box_f1.update(kept, targets, batch.scene_id)
        if self.curves is not None and self.atlas is not None:
            self.curves.update(kept, targets, batch.scene_id)
            self.atlas.update(kept, targets, batch.scene_id, list(batch.grid_center))
        every = [self._select(p, score_threshold=0.0).objects for p in predictions]
        self.box_f1_sweep.update(every, targets, batch.scene_id)

    def update_shapes(self, batch: SceneBatch, predictions: Sequence[ScenePrediction]) -> None:
        """Add the shapes of scenes; apart from ``update``, since decoding them for every slot is dear.

        Args:
            batch: scenes whose objects have shapes.
            predictions: with shapes for at least the objects that count as predicted.
        """
        if self.shape is not None and batch.objects is not None:
            kept = [self._select(p, score_threshold=self._score_threshold).objects for p in predictions]
            self.shape.update(kept, batch.objects, batch.scene_id)

    def results(self) -> dict[str, Any]:
        """Return everything the metrics say, by metric, as plain Python; every rank must call it."""
        found = {name: _plain(metric.compute()) for name, metric in self._metrics().items()}
        sweep = found.pop("box_f1_sweep", {"per_threshold": {}})
        for threshold, scores in sweep["per_threshold"].items():
            found["box_f1"]["per_threshold"][threshold] |= {name: scores[name] for name in _OF_ALL_SCORES}
        return found

    def compute(self) -> dict[str, float]:
        """Return the numbers to watch during training: ``task/number``, ``task/number/class``.

        Classes are those of the true objects.
        """
        found = self.results()
        numbers: dict[str, float] = {}
        if "accuracy" in found:
            numbers["objects/accuracy_global"] = found["accuracy"]["global_average"]
            numbers["objects/accuracy_class"] = found["accuracy"]["class_average"]
            for name, entry in found["accuracy"]["per_class"].items():
                if entry["n_total"]:
                    numbers[f"objects/accuracy/{name}"] = entry["accuracy"]
        for threshold, values in found.get("box_f1", {}).get("per_threshold", {}).items():
            numbers[f"objects/f1_{threshold}"] = values["f1"]
            for name, entry in values["per_class"].items():
                if entry["n_true"]:
                    numbers[f"objects/f1_{threshold}/{name}"] = entry["f1"]
        for task in ("occupancy", "foreground"):
            if task in found:
                numbers[f"{task}/iou"] = found[task]
        for name in (name for name in found.get("view", {}) if name != "n_views"):
            numbers[f"view/{name}"] = found["view"][name]
        return numbers

    def rows(self, per: Literal["scene", "object"]) -> list[Row]:
        """Return a row per scene or true object, the columns of the object metrics side by side."""
        if self.accuracy is None or self.box_f1 is None:
            return []
        tables = [
            metric.rows(per)
            for metric in (self.accuracy, self.box_f1, self.shape, self.atlas)
            if metric is not None
        ]
        return [{k: v for row in rows for k, v in row.items()} for rows in zip(*tables, strict=True)]

    def reset(self) -> None:
        """Forget all scenes."""
        for metric in self._metrics().values():
            metric.reset()

    def _metrics(self) -> dict[str, Metric]:
        return {name: metric for name, metric in self.named_children() if isinstance(metric, Metric)}


def _plain(value: Any) -> Any:
    """Return ``value`` with tensors turned into numbers."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return value.item() if hasattr(value, "item") else value
