# SPDX-License-Identifier: Apache-2.0
"""Matching of predicted to true objects, one to one, at least cost (DETR, Carion et al., ECCV 2020)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn

from raytran.errors import ConfigError
from raytran.losses.objects import Betas, Differences, Match, TrueObjects, pose_errors
from raytran.structs import RawObjects, sent_to

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
    def forward(
        self,
        layers: RawObjects,
        targets: TrueObjects,
        counts: Sequence[int],
        differences: Differences | None = None,
    ) -> Match:
        """Match the queries of every layer with the objects of their scene; P is the sum of min(Q, M).

        The costs come to the host in one copy, for which it waits, and the pairs go back in one.

        Args:
            layers: predictions ``(L, B, Q, ...)``.
            targets: true objects of the B scenes.
            counts: how many of them each scene has.
            differences: ``Differences.of_all`` of these, if they are there already.
        """
        if differences is None:
            differences = Differences.of_all(layers, targets)
        cost = self.cost(layers, targets, differences).cpu().numpy()
        num_layers, num_scenes, num_queries, _ = cost.shape
        pairs, first = [np.empty((2, num_layers, 0), dtype=np.int64)], 0
        for scene in range(num_scenes):
            last = first + counts[scene]
            found = [linear_sum_assignment(of_layer[scene, :, first:last]) for of_layer in cost]
            query, target = np.stack(found, axis=1)
            pairs.append(np.stack([query + scene * num_queries, target + first]))
            first = last
        return Match(*sent_to(layers.center.device, torch.from_numpy(np.concatenate(pairs, axis=2))))

    def cost(self, layers: RawObjects, targets: TrueObjects, differences: Differences) -> Tensor:
        """Return the cost ``(..., M)`` of every query ``(...)`` with every true object of all scenes."""
        likely = self._class_cost(layers.class_logits.float())[..., targets.label]
        terms = {"class": likely, **pose_errors(differences, self.betas)}
        cost = torch.stack([self.weights[name] * term for name, term in terms.items()]).sum(dim=0)
        return torch.nan_to_num(cost, nan=UNUSABLE, posinf=UNUSABLE, neginf=UNUSABLE)

    def _class_cost(self, logits: Tensor) -> Tensor:
        """Return what each class costs each query, ``(..., K + 1)`` as the logits."""
        if self.class_cost == "cross_entropy":
            return -logits.log_softmax(dim=-1)
        return -logits.softmax(dim=-1)
