# SPDX-License-Identifier: Apache-2.0
"""Foreground head: pixel features → amodal mask of all objects at image size (RayTran §3.2)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from raytran.heads.grow import growing_layers


class ForegroundHead(nn.Module):
    """Transposed convolutions of stride 2 up to image size, normalisation and non-linearity between them.

    Args:
        channels: C of the pixel features.
        widths: channels at stride 8, 4 and 2 (4 and 2 for features of stride 8), each divisible by four.
    """

    def __init__(self, *, channels: int = 256, widths: Sequence[int] = (128, 64, 32)) -> None:
        super().__init__()
        self.stride = 2 ** (len(widths) + 1)
        self.grow = growing_layers(channels, widths, outputs=1)

    def forward(self, pixels: Tensor) -> Tensor:
        """Map pixel features ``(B, N, h, w, C)`` to logits ``(B, N, H, W)``."""
        logits = self.grow(pixels.flatten(0, 1).movedim(-1, 1))
        return logits.squeeze(1).unflatten(0, pixels.shape[:2])
