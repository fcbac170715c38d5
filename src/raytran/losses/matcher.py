# SPDX-License-Identifier: Apache-2.0
"""Matching of predicted to true objects, one to one, at least cost (DETR, Carion et al., ECCV 2020)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn

from raytran.errors import ConfigError
from raytran.losses.objects import Betas, Match, pose_errors
from raytran.structs import ObjectSet, RawObjects

UNUSABLE = 1e6
"""Cost in place of one that is not finite, as 16-bit training meets in steps that its scaler then skips."""


CLASS_COSTS = ("probability", "cross_entropy")


class HungarianMatcher(nn.Module):
    """Finds the assignment with the least sum of all loss terms but the shape (RayTran §3.2).

    Args:
        weights: ``class``, ``center``, ``size`` and ``yaw``; other names are ignored, so that the weights of
            the loss can be given.
        class_cost: what an object's class costs a query that gives it the probability p. ``probability``: −p,
            as in DETR; ``cross_entropy``: −log p, the loss itself as the paper has it, which is unbounded and
            outweighs the pose of a query that is sure of a wrong class.
        center_beta: of the centre's smooth L1, see ``Betas``.
        yaw_beta: of the yaw's.

    Raises:
        ConfigError: there is no such ``class_cost``, or a beta is negative.
    """

    def __init__(
        self,
        *,
        weights: Mapping[str, float],
        class_cost: Literal["probability", "cross_entropy"] = "probability",
        center_beta: float = Betas().center,
        yaw_beta: float = Betas().yaw,
    ) -> None:
        super().__init__()
        if class_cost not in CLASS_COSTS:
            raise ConfigError(f"unknown class_cost={class_cost}: choose one of {', '.join(CLASS_COSTS)}")
        self.class_cost = class_cost
        self.betas = Betas(center_beta, yaw_beta).checked()
        self.weights = {name: float(weights[name]) for name in ("class", "center", "size", "yaw")}

    @torch.no_grad()
    def forward(self, raw: RawObjects, targets: Sequence[ObjectSet]) -> list[Match]:
        """Match one decoder layer's queries ``(B, Q, ...)`` with the objects of B scenes."""
        return [self._match(raw, scene, objects) for scene, objects in enumerate(targets)]

    def _match(self, raw: RawObjects, scene: int, objects: ObjectSet) -> Match:
        device = raw.center.device
        query, target = linear_sum_assignment(self.cost(raw, scene, objects).cpu().numpy())
        return Match(torch.as_tensor(query, device=device), torch.as_tensor(target, device=device))

    def cost(self, raw: RawObjects, scene: int, objects: ObjectSet) -> Tensor:
        """Return the cost ``(Q, M)`` of every query of ``scene`` with every true object."""
        errors = pose_errors(
            raw.center[scene, :, None],
            raw.log_size[scene, :, None],
            raw.yaw_vector[scene, :, None],
            objects,
            self.betas,
        )
        terms = {"class": self._class_cost(raw.class_logits[scene].float())[:, objects.label], **errors}
        cost = torch.stack([self.weights[name] * term for name, term in terms.items()]).sum(dim=0)
        return torch.nan_to_num(cost, nan=UNUSABLE, posinf=UNUSABLE, neginf=UNUSABLE)

    def _class_cost(self, logits: Tensor) -> Tensor:
        """Return what each class costs each query, ``(Q, K + 1)`` as the logits."""
        if self.class_cost == "cross_entropy":
            return -logits.log_softmax(dim=-1)
        return -logits.softmax(dim=-1)
