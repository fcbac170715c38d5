# SPDX-License-Identifier: Apache-2.0
"""What every backbone has in common: features of each view, averaged into the voxels they are joined with."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from raytran.backbone.efficientnet import EfficientNetLite0
from raytran.backbone.resnet import ResNet18
from raytran.errors import ShapeError, check_shape
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.center_tracer import CenterTracer
from raytran.ops.pairs import PairList
from raytran.ops.splat import splat_features
from raytran.ops.triton.block_pairs import BlockPairs

ImageEncoder = ResNet18 | EfficientNetLite0
"""Normalised images ``(n, 3 or 4, H, W)`` → features ``(n, out_channels, H/stride, W/stride)``."""


class LiftingBackbone(nn.Module, ABC):
    """Images and pixel-voxel pairs → voxel features and pixel features.

    Args:
        resnet: the image encoder.
        channels: C of the 2D and 3D representations.

    Attributes:
        blocks: what mixes the two representations after the start; may be empty.
        voxel_norm: the last layer of the voxels.
        pixel_norm: the last layer of the pixels.
        tracer: finds the pairs; None where rays join them.
        checkpoint_blocks: in training compute the blocks twice instead of keeping what is inside them.
    """

    image_mean: Tensor
    image_std: Tensor
    blocks: nn.ModuleList
    voxel_norm: nn.Module
    pixel_norm: nn.Module
    tracer: CenterTracer | None = None
    checkpoint_blocks: bool = False

    def __init__(self, *, resnet: ImageEncoder, channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.resnet = resnet
        self.projection = nn.Linear(resnet.out_channels, channels)
        # Those that the encoder's weights were trained on; a mask channel is left as it is.
        shift, scale = [*resnet.image_mean, 0.0], [*resnet.image_std, 1.0]
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
            update_pixels = self.updates_pixels(index, with_pixels=with_pixels)
            voxels, pixels = self._run(block, voxels, pixels, pairs, update_pixels)
        if not with_pixels:
            return self.voxel_norm(voxels), None
        return self.voxel_norm(voxels), self.pixel_norm(pixels).unflatten(0, images.shape[:2])

    def embed(self, images: Tensor, cameras: Cameras, grid: VoxelGrid) -> Tensor:
        """Return the pixel features at the start, ``(B · N, h, w, C)``; see ``forward``."""
        check_shape(images, f"B N {self.resnet.input_channels} H W", "images")
        if images.shape[-2] % self.stride or images.shape[-1] % self.stride:
            raise ShapeError(
                f"expected images with sides divisible by {self.stride}, got {tuple(images.shape[-2:])}"
            )
        scaled = images.flatten(0, 1).to(self.image_mean.dtype)
        if not images.is_floating_point():
            scaled = scaled / 255
        normalized = (scaled - self.image_mean[:, None, None]) / self.image_std[:, None, None]
        return self.projection(self.resnet(normalized).movedim(1, -1))

    @abstractmethod
    def start_voxels(self, splatted: Tensor, seen: Tensor, grid: VoxelGrid) -> Tensor:
        """Return the voxel features at the start, ``(B, X, Y, Z, C)``.

        Args:
            splatted: ``(B · X · Y · Z, C)`` mean features of the pixels joined with each voxel.
            seen: ``(B · X · Y · Z,)`` bool, whether there is any.
            grid: the voxel grids.
        """

    def updates_pixels(self, index: int, *, with_pixels: bool) -> bool:
        """Say whether block ``index`` changes the pixels: of the last one only pixel features need it."""
        return with_pixels or index + 1 < len(self.blocks)

    def idle_modules(self, *, with_pixels: bool) -> tuple[str, ...]:
        """Return the names of the sub-modules that no gradient of ``forward`` reaches."""
        frozen = ("resnet",) if self.resnet.frozen else ()
        return frozen if with_pixels else (*frozen, "pixel_norm")

    def _run(
        self,
        block: nn.Module,
        voxels: Tensor,
        pixels: Tensor,
        pairs: PairList | BlockPairs,
        update_pixels: bool,
    ) -> tuple[Tensor, Tensor]:
        return block(voxels, pixels, pairs, update_pixels=update_pixels)
