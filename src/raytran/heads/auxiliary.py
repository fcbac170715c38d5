# SPDX-License-Identifier: Apache-2.0
"""The dense heads: occupancy of the scene, and an amodal foreground mask of each view (RayTran §3.2)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from raytran.errors import ConfigError
from raytran.norms import GroupNorm

GROUPS = 4
"""Groups of the normalisation between two layers of an upsampler."""


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


class ForegroundHead(nn.Module):
    """Transposed convolutions of stride 2 up to image size, normalisation and non-linearity between them.

    Args:
        channels: C of the pixel features.
        widths: channels at stride 8, 4 and 2 (4 and 2 for features of stride 8), each divisible by four.
    """

    def __init__(self, *, channels: int = 256, widths: Sequence[int] = (128, 64, 32)) -> None:
        super().__init__()
        self.stride = 2 ** (len(widths) + 1)
        self.upsampler = image_upsampler(channels, widths, outputs=1)

    def forward(self, pixels: Tensor) -> Tensor:
        """Map pixel features ``(B, N, h, w, C)`` to logits ``(B, N, H, W)``."""
        logits = self.upsampler(pixels.flatten(0, 1).movedim(-1, 1))
        return logits.squeeze(1).unflatten(0, pixels.shape[:2])


def check_widths(widths: Sequence[int], groups: int) -> None:
    """Raise unless there are widths, each divisible by the number of groups of their normalisation.

    Raises:
        ConfigError: a width is not, or there is none.
    """
    if not widths or any(width % groups for width in widths):
        raise ConfigError(
            f"widths of a head are {list(widths)}: give one or more, each divisible by {groups}"
        )


def image_upsampler(channels: int, widths: Sequence[int], outputs: int) -> nn.Sequential:
    """Return transposed convolutions of stride 2, normalisation and non-linearity between them.

    The last one makes the outputs directly, so that full resolution never holds more channels than these.

    Args:
        channels: C of the features ``(n, C, h, w)``.
        widths: channels after each layer but the last, each divisible by ``GROUPS``.
        outputs: channels of the result ``(n, outputs, s·h, s·w)`` with s = 2 to the number of layers.

    Raises:
        ConfigError: there is no width, or one that is not divisible.
    """
    check_widths(widths, GROUPS)
    layers: list[nn.Module] = []
    for inputs, width in zip((channels, *widths[:-1]), widths, strict=True):
        layers += [
            nn.ConvTranspose2d(inputs, width, 4, stride=2, padding=1),
            GroupNorm(GROUPS, width),
            nn.ReLU(inplace=True),
        ]
    layers.append(nn.ConvTranspose2d(widths[-1], outputs, 4, stride=2, padding=1))
    return nn.Sequential(*layers)
