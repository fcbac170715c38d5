# SPDX-License-Identifier: Apache-2.0
"""Intersection over union of the scene occupancy and of the foreground masks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from raytran.errors import ShapeError
from raytran.metrics.records import RecordMetric, SceneRecord


class _PooledIoU(RecordMetric):
    """Sum of the intersections over sum of the unions, so that large scenes weigh more than small ones."""

    # One row for a scene: cells in the intersection, cells in the union.
    truth_columns = 2
    prediction_columns = 0

    def __init__(self, *, threshold: float = 0.5, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.threshold = threshold

    def update(self, probability: Tensor, target: Tensor, scene_ids: Sequence[str]) -> None:
        """Count the cells of scenes.

        Args:
            probability: ``(B, ...)`` in [0, 1].
            target: ``(B, ...)`` bool.
            scene_ids: the name of each of the B scenes.

        Raises:
            ShapeError: the shapes differ, or there are not as many names as scenes.
        """
        if probability.shape != target.shape or len(scene_ids) != len(target):
            raise ShapeError(
                "expected probability and target of one shape with a name for each scene, got "
                f"{tuple(probability.shape)}, {tuple(target.shape)} and {len(scene_ids)} names"
            )
        predicted, true = probability > self.threshold, target.bool()
        both, either = ((predicted & true).flatten(1).sum(dim=1), (predicted | true).flatten(1).sum(dim=1))
        for name, *counts in zip(scene_ids, both.tolist(), either.tolist(), strict=True):
            table = torch.tensor([counts], dtype=torch.float64)
            self.keep(SceneRecord(name, table, table.new_zeros(0, self.prediction_columns)))

    def compute(self) -> Tensor:
        """Return the IoU, a float64 scalar; 0 if nothing is predicted and nothing is true."""
        none = torch.zeros(1, self.truth_columns, dtype=torch.float64)
        both, either = torch.cat([none, *(scene.truths for scene in self.scenes())]).sum(dim=0)
        return both / either.clamp(min=1)


class SceneOccupancyIoU(_PooledIoU):
    """IoU of the occupied voxels, ``(B, X, Y, Z)``, pooled over all scenes.

    Args:
        threshold: probability above which a voxel counts as occupied.
        **kwargs: see ``torchmetrics.Metric``.
    """


class ForegroundIoU(_PooledIoU):
    """IoU of the foreground pixels, ``(B, N, H, W)``, pooled over all frames of all scenes.

    Args:
        threshold: probability above which a pixel counts as foreground.
        **kwargs: see ``torchmetrics.Metric``.
    """
