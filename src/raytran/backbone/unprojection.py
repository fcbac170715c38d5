# SPDX-License-Identifier: Apache-2.0
"""A backbone without attention, to measure attention against: ImVoxelNet (Rukhovich et al., WACV 2022).

Each voxel gets the mean of the features under its centre over the views that see it; 3D convolutions do the
rest. Nothing flows back from the voxels to the pixels: pixel features are those of each view alone.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from raytran.backbone.lifting import ImageEncoder, LiftingBackbone
from raytran.errors import ConfigError
from raytran.geometry.grid import VoxelGrid
from raytran.ops.center_tracer import CenterTracer


class UnprojectionBackbone(LiftingBackbone):
    """Features per view, averaged under the voxels' centres, then a 3D encoder-decoder.

    Of ImVoxelNet this has the unprojection, the residual encoder-decoder with additive skips, batch
    normalisation and zeros for unseen voxels. Its channels do not double from level to level, so that it has
    about as many parameters as ray-traced blocks of the same ``channels`` and ``num_blocks``.

    Args:
        resnet: the image encoder.
        channels: C of the 2D and 3D representations.
        num_blocks: residual blocks at the voxels' own resolution.
        num_levels: resolutions, each half the one before; the coarser ones have one residual block each.
        norm_momentum: as that of the image encoder, for the batch norms over the voxels.

    Raises:
        ConfigError: there is no block, or no level.
    """

    def __init__(
        self,
        *,
        resnet: ImageEncoder,
        channels: int = 256,
        num_blocks: int = 4,
        num_levels: int = 3,
        norm_momentum: float = 0.1,
    ) -> None:
        super().__init__(resnet=resnet, channels=channels)
        if num_blocks < 1 or num_levels < 1:
            raise ConfigError(
                "unprojection backbone needs a block and a level at least, got "
                f"num_blocks={num_blocks}, num_levels={num_levels}"
            )
        self.tracer = CenterTracer()
        self.blocks = nn.ModuleList()
        self.volume = VoxelEncoderDecoder(channels=channels, num_blocks=num_blocks, num_levels=num_levels)
        for module in self.volume.modules():
            if isinstance(module, nn.BatchNorm3d):
                module.momentum = norm_momentum
        self.voxel_norm = nn.LayerNorm(channels)
        self.pixel_norm = nn.LayerNorm(channels)

    def start_voxels(self, splatted: Tensor, seen: Tensor, grid: VoxelGrid) -> Tensor:
        """Return the voxel features, ``(B, X, Y, Z, C)``: here the whole 3D network.

        Args:
            splatted: ``(B · X · Y · Z, C)`` mean features under each voxel's centre, zeros if no view has it.
            seen: ``(B · X · Y · Z,)`` bool, whether a view has it.
            grid: the voxel grids.
        """
        return self.volume(splatted.view(-1, *grid.resolution, self.channels))


class VoxelEncoderDecoder(nn.Module):
    """Residual blocks at falling resolution; on the way back up each level is added to what came before.

    Args:
        channels: C, at every level.
        num_blocks: residual blocks of the finest level.
        num_levels: resolutions.
    """

    def __init__(self, *, channels: int, num_blocks: int, num_levels: int) -> None:
        super().__init__()
        finest = nn.Sequential(*(ResidualBlock3d(channels, stride=1) for _ in range(num_blocks)))
        coarser = (ResidualBlock3d(channels, stride=2) for _ in range(num_levels - 1))
        self.down = nn.ModuleList([finest, *coarser])
        self.up = nn.ModuleList(Upsampling(channels) for _ in range(num_levels - 1))

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
        self.grow = nn.ConvTranspose3d(channels, channels, 3, stride=2, padding=1, bias=False)
        self.norm = nn.BatchNorm3d(channels)

    def forward(self, x: Tensor, size: torch.Size) -> Tensor:
        """Map ``(B, C, ⌈X/2⌉, ⌈Y/2⌉, ⌈Z/2⌉)`` to ``(B, C, X, Y, Z)``, ``size`` = (X, Y, Z)."""
        return torch.relu_(self.norm(self.grow(x, output_size=list(size))))
