# SPDX-License-Identifier: Apache-2.0
"""The obvious, slow twin of matching and object losses: layer by layer, scene by scene, a wait for each."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from raytran.classes import PAPER_CLASSES
from raytran.geometry.rotation import symmetric_yaw_error, yaw_from_rotation
from raytran.losses.matcher import HungarianMatcher
from raytran.losses.objects import yaw_from_vector
from raytran.losses.total import TotalLoss
from raytran.structs import ObjectSet, RawObjects


def pose_errors_of(center: Tensor, log_size: Tensor, yaw_vector: Tensor, target: ObjectSet, betas) -> dict:
    true_yaw = yaw_from_rotation(target.rotation)
    turn = symmetric_yaw_error(yaw_from_vector(yaw_vector), true_yaw, target.symmetry)
    shift = center - target.center
    return {
        "center": F.smooth_l1_loss(shift, torch.zeros_like(shift), reduction="none", beta=betas.center).sum(
            -1
        ),
        "size": (log_size - target.size.log()).abs().sum(-1),
        "yaw": F.smooth_l1_loss(turn, torch.zeros_like(turn), reduction="none", beta=betas.yaw),
    }


@torch.no_grad()
def match_scene(matcher: HungarianMatcher, raw: RawObjects, scene: int, objects: ObjectSet):
    logits, boxes = raw.class_logits[scene], (raw.center, raw.log_size, raw.yaw_vector)
    likely = logits.softmax(-1) if matcher.class_cost == "probability" else logits.log_softmax(-1)
    errors = pose_errors_of(*(part[scene, :, None] for part in boxes), objects, matcher.betas)
    cost = sum(matcher.weights[name] * error for name, error in errors.items())
    cost = cost - matcher.weights["class"] * likely[:, objects.label]
    return tuple(map(torch.as_tensor, linear_sum_assignment(cost.numpy())))


def object_terms(loss: TotalLoss, layers: Sequence[RawObjects], targets: Sequence[ObjectSet]) -> dict:
    """Return the terms of the objects, by the names that ``TotalLoss`` gives them."""
    found = {}
    weight = torch.ones(len(PAPER_CLASSES) + 1, dtype=layers[0].center.dtype)
    weight[len(PAPER_CLASSES)] = loss.no_object_weight
    count = sum(map(len, targets)) or len(targets)
    for index, raw in enumerate(layers):
        label = torch.full(raw.class_logits.shape[:2], len(PAPER_CLASSES))
        terms = dict.fromkeys(("center", "size", "yaw"), raw.center.new_zeros(()))
        for scene, objects in enumerate(targets):
            query, target = match_scene(loss.matcher, raw, scene, objects)
            label[scene, query] = objects.label[target]
            boxes = (raw.center, raw.log_size, raw.yaw_vector)
            errors = pose_errors_of(
                *(part[scene, query] for part in boxes), objects.select(target), loss.betas
            )
            terms = {name: terms[name] + error.sum() / count for name, error in errors.items()}
        terms["class"] = F.cross_entropy(raw.class_logits.flatten(0, 1), label.flatten(), weight=weight)
        suffix = "" if index + 1 == len(layers) else f"/layer{index}"
        found |= {f"objects/{name}{suffix}": value for name, value in terms.items()}
    return found
