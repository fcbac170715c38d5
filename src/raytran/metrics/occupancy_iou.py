# SPDX-License-Identifier: Apache-2.0
"""Intersection over union of the scene occupancy and of the foreground masks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from raytran.errors import ShapeError
from raytran.metrics.per_scene import SceneMetric, SceneRecord


class _PooledIoU(SceneMetric):
    """Sum of the intersections over sum of the unions, so that large scenes weigh more than small ones."""

    # One row for a scene: cells in the intersection, cells in the union.
    truth_columns = 2

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
            self.add(SceneRecord(name, torch.tensor([counts], dtype=torch.float64)))

    def compute(self) -> Tensor:
        """Return the IoU, a float64 scalar; 0 if nothing is predicted and nothing is true."""
        both, either = self.truths().sum(dim=0)
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
