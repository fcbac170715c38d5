# SPDX-License-Identifier: Apache-2.0
"""Shape head: query embedding → 63³ occupancy of the object's own box (RayTran §3.2)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from raytran.heads.auxiliary import check_widths
from raytran.norms import GroupNorm


class ShapeHead(nn.Module):
    """A linear layer to 4³ cells, then four transposed 3D convolutions: 4 → 8 → 16 → 32 → 63 cells a side.

    Args:
        channels: C of the query embedding.
        widths: channels at 4³, 8³, 16³ and 32³ cells, each divisible by ``GROUPS``.

    Raises:
        ConfigError: a width is not.
    """

    GROUPS = 4

    def __init__(self, *, channels: int = 256, widths: Sequence[int] = (256, 128, 64, 32)) -> None:
        super().__init__()
        check_widths(widths, self.GROUPS)
        self.widths = tuple(widths)
        self.start = nn.Linear(channels, self.widths[0] * 4**3)
        layers: list[nn.Module] = []
        for width, next_width in zip(self.widths, self.widths[1:], strict=False):
            layers += [_normalize(width), nn.ConvTranspose3d(width, next_width, 4, stride=2, padding=1)]
        # (32 - 1) · 2 - 2 + 3 = 63
        layers += [
            _normalize(self.widths[-1]),
            nn.ConvTranspose3d(self.widths[-1], 1, 3, stride=2, padding=1),
        ]
        self.upsampler = nn.Sequential(*layers)

    @property
    def in_channels(self) -> int:
        """Numbers of each object that ``forward`` reads."""
        return self.start.in_features

    def forward(self, embedding: Tensor) -> Tensor:
        """Map embeddings ``(M, C)`` to occupancy logits ``(M, 63, 63, 63)``, indexed [x, y, z]."""
        start = self.start(embedding).view(-1, self.widths[0], 4, 4, 4)
        return self.upsampler(start).squeeze(1)


def _normalize(width: int) -> nn.Sequential:
    # Normalisation per object: the result does not depend on what else is in the batch.
    return nn.Sequential(GroupNorm(ShapeHead.GROUPS, width), nn.ReLU(inplace=True))
