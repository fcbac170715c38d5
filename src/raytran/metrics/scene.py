# SPDX-License-Identifier: Apache-2.0
"""Intersection over union of the scene occupancy and of the foreground masks."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from raytran.errors import ShapeError


class _PooledIoU(Metric):
    """Sum of the intersections over sum of the unions, so that large scenes weigh more than small ones."""

    is_differentiable = False
    higher_is_better = True
    full_state_update = False

    intersection: Tensor
    union: Tensor

    def __init__(self, *, threshold: float = 0.5, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.threshold = threshold
        self.add_state("intersection", default=torch.tensor(0), dist_reduce_fx="sum")
        self.add_state("union", default=torch.tensor(0), dist_reduce_fx="sum")

    def _add(self, probability: Tensor, target: Tensor) -> None:
        if probability.shape != target.shape:
            raise ShapeError(
                f"expected probability and target of one shape, got {tuple(probability.shape)} "
                f"and {tuple(target.shape)}"
            )
        predicted, true = probability > self.threshold, target.bool()
        self.intersection += (predicted & true).sum()
        self.union += (predicted | true).sum()

    def compute(self) -> Tensor:
        """Return the IoU, a scalar; 0 if nothing is predicted and nothing is true."""
        return self.intersection / self.union.clamp(min=1)


class SceneOccupancyIoU(_PooledIoU):
    """IoU of the occupied voxels, pooled over all scenes.

    Args:
        threshold: probability above which a voxel counts as occupied.
        **kwargs: see ``torchmetrics.Metric``.
    """

    def update(self, probability: Tensor, target: Tensor) -> None:
        """Count the voxels of scenes.

        Args:
            probability: ``(..., X, Y, Z)`` in [0, 1].
            target: ``(..., X, Y, Z)`` bool.

        Raises:
            ShapeError: the shapes differ.
        """
        self._add(probability, target)


class ForegroundIoU(_PooledIoU):
    """IoU of the foreground pixels, pooled over all frames of all scenes.

    Args:
        threshold: probability above which a pixel counts as foreground.
        **kwargs: see ``torchmetrics.Metric``.
    """

    def update(self, probability: Tensor, target: Tensor) -> None:
        """Count the pixels of frames.

        Args:
            probability: ``(..., H, W)`` in [0, 1].
            target: ``(..., H, W)`` bool.

        Raises:
            ShapeError: the shapes differ.
        """
        self._add(probability, target)
