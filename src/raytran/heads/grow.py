# SPDX-License-Identifier: Apache-2.0
"""From features of cells to values of pixels: what the heads that draw images share."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn

GROUPS = 4
"""Groups of the normalisation between two layers."""


def growing_layers(channels: int, widths: Sequence[int], outputs: int) -> nn.Sequential:
    """Return transposed convolutions of stride 2, normalisation and non-linearity between them.

    The last one makes the outputs directly, so that full resolution never holds more channels than these.

    Args:
        channels: C of the features ``(n, C, h, w)``.
        widths: channels after each layer but the last, each divisible by ``GROUPS``.
        outputs: channels of the result ``(n, outputs, s·h, s·w)`` with s = 2 to the number of layers.
    """
    layers: list[nn.Module] = []
    for inputs, width in zip((channels, *widths[:-1]), widths, strict=True):
        layers += [
            nn.ConvTranspose2d(inputs, width, 4, stride=2, padding=1),
            nn.GroupNorm(GROUPS, width),
            nn.ReLU(inplace=True),
        ]
    layers.append(nn.ConvTranspose2d(widths[-1], outputs, 4, stride=2, padding=1))
    return nn.Sequential(*layers)
