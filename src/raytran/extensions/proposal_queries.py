# SPDX-License-Identifier: Apache-2.0
"""Queries that the voxels of each scene propose, and the loss by which they learn to.

A heat map says for each class and voxel how likely the centre of such an object lies in it; its local maxima
become the decoder's queries. So few scenes suffice: what one voxel learns holds for all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence, Sized
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from raytran.classes import PAPER_CLASSES
from raytran.geometry.grid import VoxelGrid
from raytran.heads.objects import TYPICAL_SIZE, Queries
from raytran.losses.objects import Betas, Differences, TrueObjects, pose_errors
from raytran.losses.total import ExtensionLoss
from raytran.structs import ObjectSet, RawProposals, RawScene

RARE = 0.01
"""Probability of an object's centre in a voxel before training (focal loss, Lin et al., ICCV 2017)."""

SPREAD = 0.7
"""Standard deviation of the heat around a centre, in voxels."""

LEAST_HEAT = 0.3
"""Voxels with less heat than this learn nothing about the box."""


class ProposalQueries(nn.Module):
    """The Q voxels most likely to hold an object's centre, with their features and their guess of its box.

    Every voxel says for each class how likely the centre of such an object lies in it, and where exactly,
    how large and how turned that object is. Local maxima of the likeliest class become queries. (Two-stage
    Deformable DETR, Zhu et al., ICLR 2021, and TransFusion, Bai et al., CVPR 2022, do so in other fields.)
    The decoder refines the guesses; its gradient does not reach them, they have a loss of their own.

    Args:
        channels: C.
        num_queries: Q; may be changed after training, no parameter depends on it.
        classes: K classes, or their names.
    """

    class_layers = ("category", "likely_class")

    def __init__(self, *, channels: int, num_queries: int, classes: Sized = PAPER_CLASSES) -> None:
        super().__init__()
        self.num_queries = num_queries
        self.convolution = nn.Conv3d(channels, channels, 3, padding=1)
        self.norm = nn.LayerNorm(channels)
        self.category = nn.Linear(channels, len(classes))
        self.pose = nn.Linear(channels, 3 + 3 + 2)
        self.likely_class = nn.Linear(len(classes), channels)
        nn.init.normal_(self.pose.weight, std=0.01)
        with torch.no_grad():
            self.category.bias.fill_(-math.log(1 / RARE - 1))
            self.pose.bias.copy_(torch.tensor([0.0] * 3 + [math.log(TYPICAL_SIZE)] * 3 + [0.0, 1.0]))

    def forward(self, voxels: Tensor, grid: VoxelGrid) -> Queries:
        """Return the queries for B scenes.

        Args:
            voxels: ``(B, X, Y, Z, C)`` features.
            grid: the voxel grids, ``center`` ``(B, 3)``.
        """
        proposals, features = self._propose(voxels, grid)
        with torch.no_grad():
            chosen = self._peaks(proposals.class_logits)

        def pick(of_voxel: Tensor) -> Tensor:
            flat = of_voxel.flatten(1, 3)
            return flat.gather(1, chosen[..., None].expand(-1, -1, flat.shape[-1]))

        likely = self.likely_class(pick(proposals.class_logits).detach().sigmoid().to(features.dtype))
        center = grid.center.to(proposals.center.dtype)[:, None]
        return Queries(
            embedding=pick(features) + likely,
            reference=pick(proposals.center).detach() - center,
            log_size=pick(proposals.log_size).detach(),
            yaw_vector=pick(proposals.yaw_vector).detach(),
            proposals=proposals,
        )

    def _propose(self, voxels: Tensor, grid: VoxelGrid) -> tuple[RawProposals, Tensor]:
        """Return the guesses of all voxels and the features ``(B, X, Y, Z, C)`` they are read from."""
        features = self.norm(F.gelu(self.convolution(voxels.movedim(-1, 1)).movedim(1, -1)))
        anchor = grid.voxel_centers().to(self.pose.weight.dtype)
        offset, log_size, yaw_vector = self.pose(features).float().split([3, 3, 2], dim=-1)
        logits = self.category(features).float()
        return RawProposals(anchor, logits, anchor + offset, log_size, yaw_vector), features

    def _peaks(self, class_logits: Tensor) -> Tensor:
        """Return the numbers ``(B, Q)`` of the voxels with the highest local maxima, flattened x-major."""
        best = class_logits.amax(dim=-1)[:, None]
        is_peak = best == F.max_pool3d(best, 3, stride=1, padding=1)
        # Below all peaks come the other voxels, should there be fewer peaks than queries.
        rank = best.sigmoid() + is_peak.to(best.dtype)
        return rank.flatten(1).topk(min(self.num_queries, rank[0].numel()), dim=1).indices


class ProposalLoss(ExtensionLoss):
    """The loss of the proposals, a term of ``TotalLoss.extensions``."""

    reads = "proposals"

    def forward(
        self, raw: RawScene, targets: Sequence[ObjectSet], *, num_objects: Tensor, betas: Betas
    ) -> dict[str, Tensor]:
        """Return ``proposal_losses`` of what the network returned."""
        proposals = cast("RawProposals", raw.proposals)
        return proposal_losses(proposals, targets, num_objects=num_objects, betas=betas)


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
        true = TrueObjects.of(objects).select(which)
        differences = Differences.of(center[voxel], log_size[voxel], yaw_vector[voxel], true)
        for name, error in pose_errors(differences, betas).items():
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
