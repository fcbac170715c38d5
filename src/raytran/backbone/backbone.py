# SPDX-License-Identifier: Apache-2.0
"""The RayTran backbone: images and pixel-voxel pairs → voxel features and pixel features (RayTran §3.1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from raytran.backbone.block import RayTracedBlock
from raytran.backbone.resnet import ResNet18
from raytran.errors import ConfigError, ShapeError, check_shape
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.position import position_code
from raytran.ops.block_pairs import BlockPairs
from raytran.ops.pairs import PairList
from raytran.ops.splat import splat_features


class Backbone(nn.Module):
    """ResNet-18 per view, features averaged into voxels, then ``num_blocks`` 2D⇔3D blocks.

    Args:
        resnet: the image encoder.
        channels: C of the 2D and 3D representations.
        num_heads: attention heads of each block.
        num_blocks: number of blocks n.
        expansion: hidden channels of the blocks' feed-forwards, as a multiple of C.
        checkpoint_blocks: in training keep only what enters each block and compute the rest again for the
            backward pass: the same gradients, less memory, a forward pass of the blocks more.

    Raises:
        ConfigError: ``channels`` is not a multiple of ``num_heads``, or there is no block.
    """

    image_mean: Tensor
    image_std: Tensor

    def __init__(
        self,
        *,
        resnet: ResNet18,
        channels: int = 256,
        num_heads: int = 8,
        num_blocks: int = 4,
        expansion: int = 2,
        checkpoint_blocks: bool = False,
    ) -> None:
        super().__init__()
        if channels % num_heads or num_blocks < 1:
            raise ConfigError(
                "backbone needs channels divisible by num_heads and a block at least, got "
                f"channels={channels}, num_heads={num_heads}, num_blocks={num_blocks}"
            )
        self.channels = channels
        self.checkpoint_blocks = checkpoint_blocks
        self.resnet = resnet
        self.projection = nn.Linear(resnet.out_channels, channels)
        self.voxel_position = nn.Linear(channels, channels)
        self.ray_position = nn.Sequential(nn.Linear(6, channels), nn.GELU(), nn.Linear(channels, channels))
        self.unseen = nn.Parameter(0.02 * torch.randn(channels))
        self.blocks = nn.ModuleList(
            RayTracedBlock(channels=channels, num_heads=num_heads, expansion=expansion)
            for _ in range(num_blocks)
        )
        self.voxel_norm = nn.LayerNorm(channels)
        self.pixel_norm = nn.LayerNorm(channels)
        # ImageNet statistics, on which torchvision's weights were trained; a mask channel is left as it is.
        shift, scale = [0.485, 0.456, 0.406, 0.0], [0.229, 0.224, 0.225, 1.0]
        self.register_buffer("image_mean", torch.tensor(shift[: resnet.input_channels]), persistent=False)
        self.register_buffer("image_std", torch.tensor(scale[: resnet.input_channels]), persistent=False)

    @property
    def stride(self) -> int:
        """Image pixels along each side of a feature cell."""
        return self.resnet.stride

    def forward(
        self,
        images: Tensor,
        cameras: Cameras,
        grid: VoxelGrid,
        pairs: PairList | BlockPairs,
        *,
        with_pixels: bool = True,
    ) -> tuple[Tensor, Tensor | None]:
        """Return features of the scene and of its views.

        Args:
            images: ``(B, N, 3 or 4, H, W)`` uint8, or floating point in [0, 1].
            cameras: of leading shape ``(B, N)``.
            grid: the voxel grids, ``center`` ``(B, 3)``.
            pairs: the pixel-voxel pairs of all B scenes, for feature maps of ``H/stride × W/stride``.
            with_pixels: False leaves out the last block's 3D→2D stream, which only pixel features need.

        Returns:
            voxel features ``(B, X, Y, Z, C)``, and pixel features ``(B, N, h, w, C)`` or None.

        Raises:
            ShapeError: images have other channels than the encoder, or sides not divisible by the stride.
        """
        pixels = self.embed(images, cameras, grid)
        voxels = self.start_voxels(*splat_features(pixels.flatten(0, 2), pairs), grid)
        for index, block in enumerate(self.blocks):
            update_pixels = with_pixels or index + 1 < len(self.blocks)
            voxels, pixels = self._run(block, voxels, pixels, pairs, update_pixels)
        if not with_pixels:
            return self.voxel_norm(voxels), None
        return self.voxel_norm(voxels), self.pixel_norm(pixels).unflatten(0, images.shape[:2])

    def embed(self, images: Tensor, cameras: Cameras, grid: VoxelGrid) -> Tensor:
        """Return the pixel features that enter the first block, ``(B · N, h, w, C)``; see ``forward``."""
        check_shape(images, f"B N {self.resnet.input_channels} H W", "images")
        if images.shape[-2] % self.stride or images.shape[-1] % self.stride:
            raise ShapeError(
                f"expected images with sides divisible by {self.stride}, got {tuple(images.shape[-2:])}"
            )
        pixels = self._encode(images.flatten(0, 1))
        return pixels + self._locate_rays(cameras, grid, pixels.shape[1:3])

    def start_voxels(self, splatted: Tensor, seen: Tensor, grid: VoxelGrid) -> Tensor:
        """Return the voxel features that enter the first block, ``(B, X, Y, Z, C)``.

        Args:
            splatted: ``(B · X · Y · Z, C)`` mean features of the rays through each voxel.
            seen: ``(B · X · Y · Z,)`` bool, whether there is any.
            grid: the voxel grids.
        """
        voxels = torch.where(seen[:, None], splatted, self.unseen.to(splatted.dtype))
        return voxels.view(-1, *grid.resolution, self.channels) + self._locate_voxels(grid)

    def idle_without_pixels(self) -> tuple[str, ...]:
        """Return the names of the sub-modules that ``forward(..., with_pixels=False)`` does not reach."""
        return (f"blocks.{len(self.blocks) - 1}.pixel_stream", "pixel_norm")

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

    def _locate_rays(self, cameras: Cameras, grid: VoxelGrid, size: Sequence[int]) -> Tensor:
        """Return the embedding ``(n, h, w, C)`` of the origin and direction, in the grid, of cells' rays."""
        origin, direction = cameras.cell_rays((size[0], size[1]))
        origin = origin[..., 0, :] - grid.center[:, None, None, None]
        direction = torch.nn.functional.normalize(direction[..., 0, :], dim=-1)
        ray = torch.cat([origin.expand_as(direction), direction], dim=-1).flatten(0, 1)
        return self.ray_position(ray)

    def _encode(self, images: Tensor) -> Tensor:
        """Map images ``(n, c, H, W)`` to pixel features P⁰, ``(n, h, w, C)``."""
        scaled = images.to(self.image_mean.dtype)
        if not images.is_floating_point():
            scaled = scaled / 255
        normalized = (scaled - self.image_mean[:, None, None]) / self.image_std[:, None, None]
        return self.projection(self.resnet(normalized).movedim(1, -1))
