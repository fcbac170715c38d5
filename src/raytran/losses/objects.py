# SPDX-License-Identifier: Apache-2.0
"""Losses of class and pose (RayTran §3.2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from raytran.losses.matcher import Match
from raytran.losses.pose import Betas, pose_errors
from raytran.structs import PADDING, ObjectSet, RawObjects


def object_losses(
    raw: RawObjects,
    targets: Sequence[ObjectSet],
    matches: Sequence[Match],
    *,
    num_objects: Tensor,
    class_weight: Tensor,
    no_object_weight: float,
    betas: Betas,
) -> dict[str, Tensor]:
    """Return the class and pose losses of one decoder layer.

    Args:
        raw: predictions of B scenes.
        targets: true objects of B scenes.
        matches: pairs of slots and true objects.
        num_objects: scalar by which the pose losses' sums are divided.
        class_weight: scalar by which the cross entropies' weighted sum over slots is divided; the sum of the
            weights gives their mean.
        no_object_weight: weight of the padding class in the cross entropy.
        betas: of the poses' smooth L1.

    Returns:
        ``class``, ``center``, ``size`` and ``yaw``, scalars; zero pose losses without objects.
    """
    label = torch.full(raw.class_logits.shape[:2], PADDING, device=raw.class_logits.device)
    losses = {name: raw.center.new_zeros(()) for name in ("class", "center", "size", "yaw")}
    for scene, (objects, match) in enumerate(zip(targets, matches, strict=True)):
        label[scene, match.slot] = objects.label[match.target]
        errors = pose_errors(
            raw.center[scene, match.slot],
            raw.log_size[scene, match.slot],
            raw.yaw_vector[scene, match.slot],
            objects.select(match.target),
            betas,
        )
        for name, error in errors.items():
            losses[name] = losses[name] + error.sum() / num_objects
    weight_of = torch.ones(PADDING + 1, device=label.device)
    weight_of[PADDING] = no_object_weight
    logits = raw.class_logits.float().flatten(0, 1)
    entropy = F.cross_entropy(logits, label.flatten(), weight=weight_of, reduction="sum")
    losses["class"] = entropy / class_weight
    return losses
