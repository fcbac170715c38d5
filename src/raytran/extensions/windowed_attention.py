# SPDX-License-Identifier: Apache-2.0
"""Attention of the decoder's queries to the voxels around them, instead of to all voxels alike.

Each query attends through a Gaussian window around its reference point, whose offset and width every head
learns (SMCA, Gao et al., ICCV 2021). It reads, besides the features, the mean position of the voxels it
attends to, relative to the reference point. Plain DETR has to learn both from data, in hundreds of epochs.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from raytran.heads.decoder import VoxelAttention

WIDTHS = (0.3, 1.0)
"""Widths (standard deviation, metres) of the narrowest and of the widest head's window before training."""

UNIT = 0.1
"""Metres in which relative positions are read; at this scale a decimetre counts as much as a feature does."""


class WindowedAttention(VoxelAttention):
    """Multi-head attention to voxels, in a Gaussian window around each query's reference point.

    The score of query q and voxel v in a head is ``q·k / √D - |x_v - c|² / 2σ²``. Up to a constant in v,
    which the softmax cancels, its second term is the dot product of ``(c, -½) / σ²`` and ``(x_v, |x_v|²)``:
    four more channels of query and key, so that no bias matrix of Q × V is ever stored.

    Args:
        channels: C.
        num_heads: attention heads.
    """

    def __init__(self, *, channels: int, num_heads: int) -> None:
        super().__init__(channels=channels, num_heads=num_heads)
        self.window = nn.Linear(channels, 4 * num_heads)
        self.output = nn.Linear(channels + 3 * num_heads, channels)
        nn.init.normal_(self.window.weight, std=0.01)
        with torch.no_grad():
            log_width = torch.tensor(WIDTHS).log()
            bias = self.window.bias.view(num_heads, 4).zero_()
            bias[:, 3] = torch.lerp(log_width[0], log_width[1], torch.linspace(0, 1, num_heads))

    def forward(  # type: ignore[override]
        self, queries: Tensor, reference: Tensor, memory: Tensor, voxel_position: Tensor
    ) -> Tensor:
        """Return ``(B, Q, C)``; the arguments are those of ``DecoderLayer.forward``."""
        query, key, value = self.query(queries), self.key(memory), self.value(memory)
        # Squares of metres need more digits than 16-bit floats have.
        with torch.autocast(queries.device.type, enabled=False):
            query, key, value = (self._heads(x.float()) for x in (query, key, value))
            squared = voxel_position.square().sum(dim=-1, keepdim=True)
            place = torch.cat([voxel_position, squared], dim=-1).expand(*key.shape[:3], 4)
            window = self._window(self.window(queries.float()), reference.float())
            attended = F.scaled_dot_product_attention(
                torch.cat([query / query.shape[-1] ** 0.5, window], dim=-1),
                torch.cat([key, place], dim=-1),
                torch.cat([value, place], dim=-1),
                scale=1.0,
            )
            features, mean_position = attended[..., :-4], attended[..., -4:-1]
            relative = (mean_position - reference.float()[:, None]) / UNIT
            read = torch.cat([features, relative], dim=-1).transpose(1, 2).flatten(2)
        return self.output(read)

    def _window(self, parameters: Tensor, reference: Tensor) -> Tensor:
        """Return ``(c, -½) / σ²``, ``(B, heads, Q, 4)``."""
        parameters = self._heads(parameters)
        center = reference[:, None] + parameters[..., :3]
        precision = torch.exp(-2 * parameters[..., 3:])
        return torch.cat([center, torch.full_like(precision, -0.5)], dim=-1) * precision
