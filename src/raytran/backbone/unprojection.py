# SPDX-License-Identifier: Apache-2.0
"""A backbone without attention, to measure attention against: ImVoxelNet (Rukhovich et al., WACV 2022).

Each voxel gets the mean of the features under its centre over the views that see it; 3D convolutions do the
rest. Nothing flows back from the voxels to the pixels: pixel features are those of each view alone.
"""

from __future__ import annotations

from torch import Tensor, nn

from raytran.backbone.lifting import ImageEncoder, LiftingBackbone
from raytran.backbone.volume import VoxelEncoderDecoder
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
        self.volume = VoxelEncoderDecoder(
            channels=channels,
            num_blocks=num_blocks,
            num_levels=num_levels,
            norm_momentum=norm_momentum,
        )
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
