# SPDX-License-Identifier: Apache-2.0
"""All that protocol ``strict`` says of predicted objects, metrics that are updated and computed together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from torch import Tensor, nn

from raytran.classes import PAPER_CLASSES, Classes
from raytran.metrics.accuracy_curves import AccuracyCurves, accuracy_by_scene_size
from raytran.metrics.box_f1 import OrientedBoxF1
from raytran.metrics.error_atlas import ErrorAtlas
from raytran.metrics.per_scene import ObjectMetric, Row
from raytran.metrics.scan2cad import Scan2CADAccuracy
from raytran.structs import ObjectSet


class StrictScores(nn.Module):
    """Alignment accuracy and box F1; on request also why objects are missed, and at which limits.

    Args:
        explain: with ``AccuracyCurves``, ``ErrorAtlas`` and the accuracy by the size of the scene.
        volume_extent: size of the voxel grid, metres, for the atlas; None: unknown.
        classes: of the objects.
    """

    def __init__(
        self,
        *,
        explain: bool = True,
        volume_extent: Sequence[float] | None = None,
        classes: Classes = PAPER_CLASSES,
    ) -> None:
        super().__init__()
        self.accuracy = Scan2CADAccuracy(classes=classes)
        self.box_f1 = OrientedBoxF1(classes=classes)
        self.curves = AccuracyCurves(classes=classes) if explain else None
        self.atlas = ErrorAtlas(volume_extent=volume_extent, classes=classes) if explain else None

    def update(
        self,
        predictions: Sequence[ObjectSet],
        targets: Sequence[ObjectSet],
        scene_ids: Sequence[str],
        volume_centers: Sequence[Tensor | None] | None = None,
    ) -> None:
        """Judge scenes.

        Args:
            predictions: the objects of each scene that count as predicted.
            targets: the annotated objects of each scene.
            scene_ids: the name of each scene.
            volume_centers: ``(3,)`` centre of each scene's voxel grid, metres, or None where it is unknown.
        """
        self.accuracy.update(predictions, targets, scene_ids)
        self.box_f1.update(predictions, targets, scene_ids)
        if self.curves is not None and self.atlas is not None:
            self.curves.update(predictions, targets, scene_ids)
            self.atlas.update(predictions, targets, scene_ids, volume_centers)

    def compute(self) -> dict[str, Any]:
        """Return what stands under ``strict`` in ``metrics.json``; every rank must call it."""
        metrics: dict[str, Any] = dict(self.accuracy.compute()) | dict(self.box_f1.compute())
        if self.curves is not None and self.atlas is not None:
            metrics["by_scene_size"] = accuracy_by_scene_size(self.accuracy.rows("object"))
            metrics["curves"] = self.curves.compute()
            metrics["atlas"] = self.atlas.compute()
        return metrics

    def reset(self) -> None:
        """Forget all scenes."""
        for metric in (self.accuracy, self.box_f1, self.curves, self.atlas):
            if metric is not None:
                metric.reset()


def side_by_side(per: Literal["scene", "object"], *metrics: ObjectMetric | None) -> list[Row]:
    """Return a row for each scene or true object with the columns of several metrics of the same scenes.

    Every rank must call it.
    """
    tables = [metric.rows(per) for metric in metrics if metric is not None]
    return [
        {name: value for row in rows for name, value in row.items()} for rows in zip(*tables, strict=True)
    ]
