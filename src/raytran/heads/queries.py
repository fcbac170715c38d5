# SPDX-License-Identifier: Apache-2.0
"""Where the decoder's queries come from: learned for all scenes alike, or proposed by the voxels of each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.quasirandom import SobolEngine

from raytran.geometry.grid import VoxelGrid
from raytran.structs import CLASSES, RawProposals

QUERY_SCALE = 0.1
"""Standard deviation of the query embeddings before training: small, so that what they read outweighs it."""

TYPICAL_SIZE = 0.7
"""Side of an object before training, metres."""

RARE = 0.01
"""Probability of an object's centre in a voxel before training (focal loss, Lin et al., ICCV 2017)."""


class Queries(NamedTuple):
    """What the decoder starts from.

    Attributes:
        embedding: ``(B, Q, C)``.
        reference: ``(B, Q, 3)`` reference points, metres from the centre of the volume.
        log_size: ``(B, Q, 3)`` to which the layers' predictions of the logarithm of the size are added.
        yaw_vector: ``(B, Q, 2)`` to which those of (sin, cos) of the yaw are added.
        proposals: of all voxels, None if the queries are learned.
    """

    embedding: Tensor
    reference: Tensor
    log_size: Tensor
    yaw_vector: Tensor
    proposals: RawProposals | None


class LearnedQueries(nn.Module):
    """Q embeddings and reference points that are the same for every scene (DETR; RayTran §3.2).

    Args:
        channels: C.
        num_queries: Q.
        extent: sizes of the voxel grid, metres, over which the reference points spread at first.
    """

    extent: Tensor

    def __init__(self, *, channels: int, num_queries: int, extent: Sequence[float]) -> None:
        super().__init__()
        # Sobol's points cover the volume more evenly than random ones, and are the same in every run.
        spread = SobolEngine(3).draw(num_queries + 1)[1:] - 0.5
        self.register_buffer("extent", torch.tensor([float(side) for side in extent]), persistent=False)
        self.reference = nn.Parameter(0.8 * spread)
        self.embedding = nn.Parameter(QUERY_SCALE * torch.randn(num_queries, channels))

    def forward(self, voxels: Tensor, grid: VoxelGrid) -> Queries:
        """Return the queries for B scenes; of ``voxels`` ``(B, X, Y, Z, C)`` only B is read."""
        scenes = voxels.shape[0]
        reference = (self.reference * self.extent).expand(scenes, -1, -1)
        log_size = torch.full_like(reference, math.log(TYPICAL_SIZE))
        yaw_vector = reference.new_tensor([0.0, 1.0]).expand(*reference.shape[:2], 2)
        return Queries(self.embedding.expand(scenes, -1, -1), reference, log_size, yaw_vector, None)


class ProposalQueries(nn.Module):
    """The Q voxels most likely to hold an object's centre, with their features and their guess of its box.

    Every voxel says for each class how likely the centre of such an object lies in it, and where exactly,
    how large and how turned that object is. Local maxima of the likeliest class become queries. (Two-stage
    Deformable DETR, Zhu et al., ICLR 2021, and TransFusion, Bai et al., CVPR 2022, do so in other fields.)
    The decoder refines the guesses; its gradient does not reach them, they have a loss of their own.

    Args:
        channels: C.
        num_queries: Q; may be changed after training, no parameter depends on it.
    """

    def __init__(self, *, channels: int, num_queries: int) -> None:
        super().__init__()
        self.num_queries = num_queries
        self.convolution = nn.Conv3d(channels, channels, 3, padding=1)
        self.norm = nn.LayerNorm(channels)
        self.category = nn.Linear(channels, len(CLASSES))
        self.pose = nn.Linear(channels, 3 + 3 + 2)
        self.likely_class = nn.Linear(len(CLASSES), channels)
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
