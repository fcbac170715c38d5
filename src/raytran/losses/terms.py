# SPDX-License-Identifier: Apache-2.0
"""The loss terms that compare one tensor with another: occupancy, foreground, shapes, rendered views."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from raytran.structs import Views


def occupancy_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return the binary cross entropy of logits and bool target, both ``(B, X, Y, Z)``; mean over voxels."""
    return F.binary_cross_entropy_with_logits(logits.float(), target.float())


def foreground_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return the binary cross entropy of logits and bool target, both ``(B, N, H, W)``; mean over pixels."""
    return F.binary_cross_entropy_with_logits(logits.float(), target.float())


def shape_loss(logits: Tensor, target: Tensor, *, num_objects: Tensor) -> Tensor:
    """Return the binary cross entropy, mean over cells, sum over objects divided by ``num_objects``.

    Args:
        logits: ``(M, S, S, S)``.
        target: ``(M, S, S, S)`` bool.
        num_objects: scalar.
    """
    entropy = F.binary_cross_entropy_with_logits(logits.float(), target.float(), reduction="none")
    return entropy.flatten(1).mean(dim=1).sum() / num_objects


def view_loss(logits: Tensor, target: Views) -> Tensor:
    """Return the mean squared error of colours in [0, 1].

    Args:
        logits: ``(B, V, 3, H, W)``.
        target: ``V`` photographs of each scene, taken by the cameras that were rendered.
    """
    return F.mse_loss(logits.float().sigmoid(), target.colors())
