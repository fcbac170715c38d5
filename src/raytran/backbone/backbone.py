# SPDX-License-Identifier: Apache-2.0
"""The RayTran backbone: images and pixel-voxel pairs → voxel features and pixel features (RayTran §3.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from raytran.backbone.block import RayTracedBlock
from raytran.backbone.lifting import ImageEncoder, LiftingBackbone
from raytran.backbone.volume import VoxelEncoderDecoder
from raytran.errors import ConfigError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.position import position_code, ray_code
from raytran.ops.pairs import PairList
from raytran.ops.triton.block_pairs import BlockPairs


class Backbone(LiftingBackbone):
    """ResNet-18 per view, features averaged into voxels, then ``num_blocks`` 2D⇔3D blocks.

    Args:
        resnet: the image encoder.
        channels: C of the 2D and 3D representations.
        num_heads: attention heads of each block.
        num_blocks: number of blocks n.
        expansion: hidden channels of the blocks' feed-forwards, as a multiple of C.
        bidirectional: False leaves out 3D→2D: no block changes the pixels.
        start_levels: resolutions of a 3D encoder-decoder that the voxels pass before the first block; 0 for
            none, as in the paper.
        norm_momentum: as that of the image encoder, for the batch norms of that encoder-decoder.
        checkpoint_blocks: in training keep only what enters each block and compute the rest again for the
            backward pass: the same gradients, less memory, a forward pass of the blocks more.

    Raises:
        ConfigError: ``channels`` is not a multiple of ``num_heads``, there is no block, or ``start_levels``
            is negative.
    """

    def __init__(
        self,
        *,
        resnet: ImageEncoder,
        channels: int = 256,
        num_heads: int = 8,
        num_blocks: int = 4,
        expansion: int = 2,
        bidirectional: bool = True,
        start_levels: int = 0,
        norm_momentum: float = 0.1,
        checkpoint_blocks: bool = False,
    ) -> None:
        super().__init__(resnet=resnet, channels=channels)
        if channels % num_heads or num_blocks < 1:
            raise ConfigError(
                "backbone needs channels divisible by num_heads and a block at least, got "
                f"channels={channels}, num_heads={num_heads}, num_blocks={num_blocks}"
            )
        if start_levels < 0:
            raise ConfigError(f"start_levels must be 0 or more, got {start_levels}")
        self.bidirectional = bidirectional
        self.checkpoint_blocks = checkpoint_blocks
        self.voxel_position = nn.Linear(channels, channels)
        self.ray_position = nn.Sequential(nn.Linear(6, channels), nn.GELU(), nn.Linear(channels, channels))
        self.unseen = nn.Parameter(0.02 * torch.randn(channels))
        self.blocks = nn.ModuleList(
            RayTracedBlock(channels=channels, num_heads=num_heads, expansion=expansion)
            for _ in range(num_blocks)
        )
        self.voxel_norm = nn.LayerNorm(channels)
        self.pixel_norm = nn.LayerNorm(channels)
        # Last, so that the other parts start from the same weights with and without.
        self.volume: nn.Module = nn.Identity()
        if start_levels:
            self.volume = VoxelEncoderDecoder(
                channels=channels,
                num_blocks=1,
                num_levels=start_levels,
                norm_momentum=norm_momentum,
            )

    def embed(self, images: Tensor, cameras: Cameras, grid: VoxelGrid) -> Tensor:
        """Return the pixel features that enter the first block, ``(B · N, h, w, C)``; see ``forward``."""
        pixels = super().embed(images, cameras, grid)
        return pixels + self.ray_position(ray_code(cameras, grid, pixels.shape[1:3]))

    def start_voxels(self, splatted: Tensor, seen: Tensor, grid: VoxelGrid) -> Tensor:
        """Return the voxel features that enter the first block; as in ``LiftingBackbone``."""
        voxels = torch.where(seen[:, None], splatted, self.unseen.to(splatted.dtype))
        return self.volume(voxels.view(-1, *grid.resolution, self.channels) + self._locate_voxels(grid))

    def idle_modules(self, *, with_pixels: bool) -> tuple[str, ...]:
        """Return the names of the sub-modules that no gradient of ``forward`` reaches."""
        idle = super().idle_modules(with_pixels=with_pixels)
        still = [i for i in range(len(self.blocks)) if not self.updates_pixels(i, with_pixels=with_pixels)]
        return (*idle, *(f"blocks.{index}.pixel_stream" for index in still))

    def updates_pixels(self, index: int, *, with_pixels: bool) -> bool:
        """As in ``LiftingBackbone``; never if the blocks are not bidirectional."""
        return self.bidirectional and super().updates_pixels(index, with_pixels=with_pixels)

    def _run(
        self,
        block: nn.Module,
        voxels: Tensor,
        pixels: Tensor,
        pairs: PairList | BlockPairs,
        update_pixels: bool,
    ) -> tuple[Tensor, Tensor]:
        if not (self.checkpoint_blocks and torch.is_grad_enabled()):
            return block(voxels, pixels, pairs, update_pixels=update_pixels)
        # Nothing in a block is random: there is no generator's state to keep.
        return checkpoint(
            block,
            voxels,
            pixels,
            pairs,
            update_pixels=update_pixels,
            use_reentrant=False,
            preserve_rng_state=False,
        )

    def _locate_voxels(self, grid: VoxelGrid) -> Tensor:
        """Return the position embedding of the voxels, ``(X, Y, Z, C)``; that of every scene is the same."""
        at_origin = VoxelGrid(grid.resolution, grid.extent, torch.zeros_like(self.image_mean[:3]))
        return self.voxel_position(position_code(at_origin.voxel_centers(), grid.extent, self.channels))
