# SPDX-License-Identifier: Apache-2.0
"""Foreground head: pixel features → amodal mask of all objects at image size (RayTran §3.2)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn


class ForegroundHead(nn.Module):
    """Transposed convolutions of stride 2 up to image size, normalisation and non-linearity between them.

    The last one makes the logits directly, so that full resolution never holds more than one channel.

    Args:
        channels: C of the pixel features.
        widths: channels at stride 8, 4 and 2 (4 and 2 for features of stride 8), each divisible by
            ``GROUPS``.
    """

    GROUPS = 4

    def __init__(self, *, channels: int = 256, widths: Sequence[int] = (128, 64, 32)) -> None:
        super().__init__()
        self.stride = 2 ** (len(widths) + 1)
        layers: list[nn.Module] = []
        for inputs, outputs in zip((channels, *widths[:-1]), widths, strict=True):
            layers += [
                nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1),
                nn.GroupNorm(self.GROUPS, outputs),
                nn.ReLU(inplace=True),
            ]
        layers.append(nn.ConvTranspose2d(widths[-1], 1, 4, stride=2, padding=1))
        self.grow = nn.Sequential(*layers)

    def forward(self, pixels: Tensor) -> Tensor:
        """Map pixel features ``(B, N, h, w, C)`` to logits ``(B, N, H, W)``."""
        logits = self.grow(pixels.flatten(0, 1).movedim(-1, 1))
        return logits.squeeze(1).unflatten(0, pixels.shape[:2])
