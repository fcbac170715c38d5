# SPDX-License-Identifier: Apache-2.0
"""What the decoder starts from: learned queries, the same for every scene (RayTran §3.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.quasirandom import SobolEngine

from raytran.geometry.grid import VoxelGrid
from raytran.structs import RawProposals

QUERY_SCALE = 0.1
"""Standard deviation of the query embeddings before training: small, so that what they read outweighs it."""

TYPICAL_SIZE = 0.7
"""Side of an object before training, metres."""


class Queries(NamedTuple):
    """What the decoder starts from.

    Attributes:
        embedding: ``(B, Q, C)``.
        reference: ``(B, Q, 3)`` reference points, metres from the centre of the volume.
        log_size: ``(B, Q, 3)`` to which the layers' predictions of the logarithm of the size are added.
        yaw_vector: ``(B, Q, 2)`` to which those of (sin, cos) of the yaw are added.
        proposals: of all voxels, where a scene's voxels propose its queries; None if they are learned.
    """

    embedding: Tensor
    reference: Tensor
    log_size: Tensor
    yaw_vector: Tensor
    proposals: RawProposals | None = None


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
