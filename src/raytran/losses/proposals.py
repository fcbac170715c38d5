# SPDX-License-Identifier: Apache-2.0
"""Losses of the voxels' proposals: a heat map of the objects' centres, and the box at each centre."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from raytran.losses.pose import Betas, pose_errors
from raytran.structs import ObjectSet, RawProposals

SPREAD = 0.7
"""Standard deviation of the heat around a centre, in voxels."""

LEAST_HEAT = 0.3
"""Voxels with less heat than this learn nothing about the box."""


def proposal_losses(
    proposals: RawProposals, targets: Sequence[ObjectSet], *, num_objects: Tensor, betas: Betas
) -> dict[str, Tensor]:
    """Return the losses of the proposals of B scenes.

    The heat of a class is a Gaussian around each object's centre, one at the voxel that holds it; its loss is
    the penalty-reduced focal loss of CornerNet (Law and Deng, ECCV 2018). The pose losses are those of the
    decoder, at the voxels near a centre, weighted by their heat.

    Args:
        proposals: of all voxels.
        targets: true objects.
        num_objects: scalar by which the sums are divided.
        betas: of the poses' smooth L1.

    Returns:
        ``heat``, ``center``, ``size`` and ``yaw``, scalars.
    """
    totals = {name: proposals.center.new_zeros(()) for name in ("heat", "center", "size", "yaw")}
    for scene, objects in enumerate(targets):
        center, log_size, yaw_vector = (
            values[scene].flatten(0, 2)
            for values in (proposals.center, proposals.log_size, proposals.yaw_vector)
        )
        logits = proposals.class_logits[scene].flatten(0, 2)
        heat = center_heat(proposals.anchor[scene], objects)
        target = torch.zeros_like(logits)
        for label, of_object in zip(objects.label.tolist(), heat, strict=True):
            target[:, label] = torch.maximum(target[:, label], of_object)
        totals["heat"] = totals["heat"] + _focal_loss(logits, target) / num_objects
        which, voxel = (heat > LEAST_HEAT).nonzero(as_tuple=True)
        weight = heat[which, voxel] / torch.where(heat > LEAST_HEAT, heat, 0.0).sum(dim=1)[which]
        errors = pose_errors(center[voxel], log_size[voxel], yaw_vector[voxel], objects.select(which), betas)
        for name, error in errors.items():
            totals[name] = totals[name] + (weight * error).sum() / num_objects
    return totals


def center_heat(anchor: Tensor, objects: ObjectSet) -> Tensor:
    """Return the heat of each object at each voxel, ``(M, V)``: 1 at the voxel that holds its centre.

    Args:
        anchor: ``(X, Y, Z, 3)`` voxel centres, metres.
        objects: M objects; one whose centre is outside the grid has no heat.
    """
    voxel_size = anchor[1, 1, 1] - anchor[0, 0, 0]
    distance = (anchor.flatten(0, 2) - objects.center[:, None]) / voxel_size
    heat = torch.exp(-distance.square().sum(dim=-1) / (2 * SPREAD**2))
    holds = (distance.abs() <= 0.5).all(dim=-1)
    heat = torch.where(holds, 1.0, heat)
    return heat * holds.any(dim=1, keepdim=True)


def _focal_loss(logits: Tensor, target: Tensor) -> Tensor:
    probability = logits.sigmoid()
    found = (1 - probability).square() * F.logsigmoid(logits)
    other = (1 - target) ** 4 * probability.square() * F.logsigmoid(-logits)
    return -torch.where(target == 1, found, other).sum()
