# SPDX-License-Identifier: Apache-2.0
"""A residual 3D encoder-decoder over the voxels, as ImVoxelNet's (Rukhovich et al., WACV 2022)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from raytran.backbone.resnet import set_norm_momentum
from raytran.errors import ConfigError


class VoxelEncoderDecoder(nn.Module):
    """Residual blocks at falling resolution; on the way back up each level is added to what came before.

    Args:
        channels: C, at every level.
        num_blocks: residual blocks of the finest level.
        num_levels: resolutions.
        norm_momentum: share of each batch in the running statistics of the batch norms.

    Raises:
        ConfigError: there is no block, or no level.
    """

    def __init__(
        self, *, channels: int, num_blocks: int = 1, num_levels: int = 3, norm_momentum: float = 0.1
    ) -> None:
        super().__init__()
        if num_blocks < 1 or num_levels < 1:
            raise ConfigError(
                "a 3D encoder-decoder needs num_blocks and num_levels of at least 1, "
                f"got {num_blocks} and {num_levels}"
            )
        finest = nn.Sequential(*(ResidualBlock3d(channels, stride=1) for _ in range(num_blocks)))
        coarser = (ResidualBlock3d(channels, stride=2) for _ in range(num_levels - 1))
        self.down = nn.ModuleList([finest, *coarser])
        self.up = nn.ModuleList(Upsampling(channels) for _ in range(num_levels - 1))
        set_norm_momentum(self, norm_momentum)

    def forward(self, voxels: Tensor) -> Tensor:
        """Map ``(B, X, Y, Z, C)`` to the same; any X, Y, Z."""
        levels = [voxels.movedim(-1, 1)]
        for layer in self.down:
            levels.append(layer(levels[-1]))
        x = levels.pop()
        for layer, skip in zip(self.up, reversed(levels[1:]), strict=True):
            x = skip + layer(x, skip.shape[-3:])
        return x.movedim(1, -1)


class ResidualBlock3d(nn.Module):
    """Two 3×3×3 convolutions with a skip.

    Args:
        channels: C.
        stride: 1, or 2 to halve the resolution (rounded up).
    """

    def __init__(self, channels: int, *, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv3d(channels, channels, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm3d(channels)
        self.conv2 = nn.Conv3d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm3d(channels)
        self.skip: nn.Module = nn.Identity()
        if stride != 1:
            self.skip = nn.Sequential(
                nn.Conv3d(channels, channels, 1, stride, bias=False), nn.BatchNorm3d(channels)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, C, X, Y, Z)`` to ``(B, C, X/stride, Y/stride, Z/stride)``."""
        out = torch.relu_(self.bn1(self.conv1(x)))
        return torch.relu_(self.bn2(self.conv2(out)) + self.skip(x))


class Upsampling(nn.Module):
    """A transposed 3×3×3 convolution of stride 2.

    Args:
        channels: C.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convolution = nn.ConvTranspose3d(channels, channels, 3, stride=2, padding=1, bias=False)
        self.norm = nn.BatchNorm3d(channels)

    def forward(self, x: Tensor, size: torch.Size) -> Tensor:
        """Map ``(B, C, ⌈X/2⌉, ⌈Y/2⌉, ⌈Z/2⌉)`` to ``(B, C, X, Y, Z)``, ``size`` = (X, Y, Z)."""
        return torch.relu_(self.norm(self.convolution(x, output_size=list(size))))
