# SPDX-License-Identifier: Apache-2.0
"""A backbone without attention, to measure attention against: ImVoxelNet (Rukhovich et al., WACV 2022).

Each voxel gets the mean of the features under its centre over the views that see it; 3D convolutions do the
rest. Nothing flows back from the voxels to the pixels: pixel features are those of each view alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from raytran.backbone.backbone import ImageEncoder, VoxelBackbone
from raytran.extensions.unet3d import VoxelEncoderDecoder
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList, Pairs
from raytran.ops.splat import splat_in_chunks


class UnprojectionBackbone(VoxelBackbone):
    """Features per view, averaged under the voxels' centres, then a 3D encoder-decoder.

    Of ImVoxelNet this has the unprojection, the residual encoder-decoder with additive skips, batch
    normalisation and zeros for unseen voxels. Its channels do not double from level to level, so that it has
    about as many parameters as ray-traced blocks of the same ``channels`` and ``num_blocks``.

    Args:
        encoder: the image encoder.
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
        encoder: ImageEncoder,
        channels: int = 256,
        num_blocks: int = 4,
        num_levels: int = 3,
        norm_momentum: float = 0.1,
    ) -> None:
        super().__init__(encoder=encoder, channels=channels)
        self.voxel_network = VoxelEncoderDecoder(
            channels=channels, num_blocks=num_blocks, num_levels=num_levels, norm_momentum=norm_momentum
        )
        self.voxel_norm = nn.LayerNorm(channels)
        self.pixel_norm = nn.LayerNorm(channels)

    @torch.compiler.disable
    def trace(
        self,
        cameras: Cameras,
        grid: VoxelGrid,
        feature_size: tuple[int, int],
        *,
        ray_tracer: Callable[..., Pairs],
        rays_per_cell: int,
    ) -> PairList:
        """Return the pairs of ``pair_centers``; no ray is traced."""
        pairs = pair_centers(cameras, grid, feature_size)
        # Both orders are made here, outside of code that is compiled for one size.
        pairs.orders()
        return pairs

    def forward(
        self,
        images: Sequence[Tensor],
        cameras: Sequence[Cameras],
        grid: VoxelGrid,
        pairs: Sequence[Pairs],
        *,
        with_pixels: bool = True,
    ) -> tuple[Tensor, list[Tensor] | None]:
        """Return features of the scene and of its views; as in ``VoxelBackbone``."""
        self.refuse_chunks_in_training(images)
        pixels = [self.image_features(chunk) for chunk in images]
        mean, _ = splat_in_chunks([features.flatten(0, 2) for features in pixels], pairs)
        voxels = self.voxel_network(mean.view(-1, *grid.resolution, self.channels))
        voxels = self.voxel_norm(voxels)
        if not with_pixels:
            return voxels, None
        return voxels, [
            self.pixel_norm(features).unflatten(0, chunk.shape[:2])
            for features, chunk in zip(pixels, images, strict=True)
        ]

    def idle_modules(self, *, with_pixels: bool) -> tuple[str, ...]:
        """Return the names of the sub-modules that no gradient of ``forward`` reaches."""
        idle = super().idle_modules(with_pixels=with_pixels)
        return idle if with_pixels else (*idle, "pixel_norm")


def pair_centers(cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int]) -> PairList:
    """Join each voxel, in each view with its centre in the picture, with the cell that the centre falls on.

    So a voxel has at most one pixel a view, whatever it covers of the image, and the mean over its pairs is
    the unprojection of ImVoxelNet (Rukhovich et al., WACV 2022).

    Args:
        cameras: of leading shape ``(N,)`` or ``(B, N)``.
        grid: the voxel grids, ``center`` ``(3,)`` or ``(B, 3)``.
        feature_size: ``(h, w)`` of the feature maps.
    """
    height, width = feature_size
    centers = grid.voxel_centers().flatten(-4, -2).to(cameras.intrinsics.dtype)
    scaled = cameras.scaled_to(feature_size)
    place, depth = scaled.project(centers[..., None, :, :])
    inside = scaled.sees(place, depth)
    views, scenes = inside.flatten(0, -2), centers.flatten(0, -3).shape[0] if centers.ndim > 2 else 1
    view, voxel = views.nonzero(as_tuple=True)
    column, row = place.flatten(0, -3)[view, voxel].long().unbind(dim=-1)
    pixel = (view * height + row) * width + column
    voxel = voxel + grid.num_voxels * (view // (len(views) // scenes))
    # Stable: within a pixel the voxels stay in order.
    pixel, order = torch.sort(pixel, stable=True)
    return PairList(
        pixel,
        voxel[order],
        len(views) * height * width,
        scenes * grid.num_voxels,
        pixel_shape=(len(views), height, width),
        voxel_shape=(scenes, *grid.resolution),
    )
