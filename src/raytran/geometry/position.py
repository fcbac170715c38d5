# SPDX-License-Identifier: Apache-2.0
"""Sinusoidal code of positions in the volume."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

LOWEST, HIGHEST = 0.5, 16.0
"""Waves that fit into the volume, of the lowest and of the highest frequency. Vaswani et al. (2017) span a
ratio of 10,000; over a voxel grid, waves outside of these would be constant or noise."""


def position_code(points: Tensor, extent: Sequence[float], channels: int) -> Tensor:
    """Return sines and cosines of the three coordinates at rising frequencies.

    Args:
        points: ``(..., 3)`` metres from the centre of the volume.
        extent: sizes of the volume, metres.
        channels: C; what exceeds a multiple of six is filled with zeros.

    Returns:
        ``(..., C)``.
    """
    count = channels // 6
    steps = torch.linspace(0, 1, count, dtype=points.dtype, device=points.device)
    cycles = LOWEST * (HIGHEST / LOWEST) ** steps
    angle = (2 * math.pi * points / points.new_tensor(list(extent)))[..., None] * cycles
    code = torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(-2)
    return torch.nn.functional.pad(code, (0, channels - 6 * count))
