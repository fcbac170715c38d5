# SPDX-License-Identifier: Apache-2.0
"""Sinusoidal code of 3D positions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn


class PositionEmbedding(nn.Module):
    """Sines and cosines of the three coordinates at rising frequencies, then a linear layer.

    One wave of the lowest frequency spans twice the volume, one of the highest a sixteenth of it; lower or
    higher ones (Vaswani et al., 2017, have a ratio of 10,000) would be constant or noise over a voxel grid.

    Args:
        channels: C.
        extent: sizes of the volume, metres.
    """

    angular: Tensor

    def __init__(self, *, channels: int, extent: Sequence[float]) -> None:
        super().__init__()
        count = channels // 6
        self.linear = nn.Linear(6 * count, channels)
        cycles = 0.5 * 32.0 ** torch.linspace(0, 1, count)
        angular = 2 * math.pi * cycles[None, :] / torch.tensor(extent)[:, None]
        self.register_buffer("angular", angular, persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        """Map points ``(..., 3)``, metres from the centre of the volume, to ``(..., C)``."""
        angle = points[..., None] * self.angular
        return self.linear(torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(-2))
