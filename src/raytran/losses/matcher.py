# SPDX-License-Identifier: Apache-2.0
"""Matching of predicted to true objects, one to one, at least cost (DETR, Carion et al., ECCV 2020)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn

from raytran.losses.pose import pose_errors
from raytran.types import ObjectSet, RawObjects

UNUSABLE = 1e6
"""Cost in place of one that is not finite, as 16-bit training meets in steps that its scaler then skips."""


class Match(NamedTuple):
    """Matched pairs of one scene.

    Attributes:
        slot: ``(m,)`` int64, query slot of each pair.
        target: ``(m,)`` int64, true object of each pair; m = min(Q, M).
    """

    slot: Tensor
    target: Tensor


class HungarianMatcher(nn.Module):
    """Finds the assignment with the least sum of all loss terms but the shape (RayTran §3.2).

    As in DETR, the class costs minus its probability instead of the cross entropy, which is unbounded and
    would outweigh the pose of a slot that is sure of a wrong class.

    Args:
        weights: ``class``, ``center``, ``size`` and ``yaw``; other names are ignored, so that the weights of
            the loss can be given.
    """

    def __init__(self, *, weights: Mapping[str, float]) -> None:
        super().__init__()
        self.weights = {name: float(weights[name]) for name in ("class", "center", "size", "yaw")}

    @torch.no_grad()
    def forward(self, raw: RawObjects, targets: Sequence[ObjectSet]) -> list[Match]:
        """Match one decoder layer's slots ``(B, Q, ...)`` with the objects of B scenes."""
        return [self._match(raw, scene, objects) for scene, objects in enumerate(targets)]

    def _match(self, raw: RawObjects, scene: int, objects: ObjectSet) -> Match:
        device = raw.center.device
        slot, target = linear_sum_assignment(self.cost(raw, scene, objects).cpu().numpy())
        return Match(torch.as_tensor(slot, device=device), torch.as_tensor(target, device=device))

    def cost(self, raw: RawObjects, scene: int, objects: ObjectSet) -> Tensor:
        """Return the cost ``(Q, M)`` of every slot of ``scene`` with every true object."""
        probability = raw.class_logits[scene].float().softmax(dim=-1)
        errors = pose_errors(
            raw.center[scene, :, None], raw.log_size[scene, :, None], raw.yaw_vector[scene, :, None], objects
        )
        terms = {"class": -probability[:, objects.label], **errors}
        cost = torch.stack([self.weights[name] * term for name, term in terms.items()]).sum(dim=0)
        return torch.nan_to_num(cost, nan=UNUSABLE, posinf=UNUSABLE, neginf=UNUSABLE)
