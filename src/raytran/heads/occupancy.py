# SPDX-License-Identifier: Apache-2.0
"""Occupancy head: voxel features → occupancy of the scene by all objects together (RayTran §3.2)."""

from __future__ import annotations

from torch import Tensor, nn


class OccupancyHead(nn.Module):
    """One 3×3×3 convolution.

    Args:
        channels: C of the voxel features.
    """

    def __init__(self, *, channels: int = 256) -> None:
        super().__init__()
        self.convolution = nn.Conv3d(channels, 1, 3, padding=1)

    def forward(self, voxels: Tensor) -> Tensor:
        """Map voxel features ``(B, X, Y, Z, C)`` to logits ``(B, X, Y, Z)``."""
        return self.convolution(voxels.movedim(-1, 1)).squeeze(1)
