# SPDX-License-Identifier: Apache-2.0
"""The RayTran backbone: images and pixel-voxel pairs → voxel features and pixel features (RayTran §3.1)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from raytran.backbone.block import RayTracedBlock
from raytran.errors import ConfigError, ShapeError, check_shape
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid, ray_code, voxel_code
from raytran.norms import LayerNorm
from raytran.ops.pairs import Pairs
from raytran.ops.splat import splat_in_chunks


class ImageEncoder(nn.Module):
    """The interface of an image encoder: the base of ``ResNet18`` and of encoders of your own.

    Called with normalised images ``(n, input_channels, H, W)``, it returns features
    ``(n, out_channels, H/stride, W/stride)``.

    Attributes:
        stride: image pixels along each side of a feature cell.
        input_channels: 3, or 4 with a foreground mask.
        out_channels: channels of the features.
        image_mean: mean of red, green and blue in [0, 1] in the images its weights were trained on.
        image_std: their standard deviation.
        frozen: its weights never train.
        random_fallback: it should have started from pretrained weights and found none.
    """

    stride: int
    input_channels: int
    out_channels: int
    image_mean: tuple[float, float, float]
    image_std: tuple[float, float, float]
    frozen: bool = False
    random_fallback: bool = False


class ImageFeatures(nn.Module):
    """Images → features of ``C`` channels at the encoder's stride, each view on its own.

    Args:
        encoder: the image encoder.
        channels: C.
    """

    image_mean: Tensor
    image_std: Tensor

    def __init__(self, *, encoder: ImageEncoder, channels: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.projection = nn.Linear(encoder.out_channels, channels)
        # A mask channel is no colour: it goes in as it is.
        shift = [*encoder.image_mean, 0.0]
        scale = [*encoder.image_std, 1.0]
        self.register_buffer("image_mean", torch.tensor(shift[: encoder.input_channels]), persistent=False)
        self.register_buffer("image_std", torch.tensor(scale[: encoder.input_channels]), persistent=False)

    @property
    def stride(self) -> int:
        """Image pixels along each side of a feature cell."""
        return self.encoder.stride

    def forward(self, images: Tensor) -> Tensor:
        """Return pixel features ``(B · N, h, w, C)``.

        Args:
            images: ``(B, N, 3 or 4, H, W)`` uint8, or floating point in [0, 1].

        Raises:
            ShapeError: images have other channels than the encoder, or sides not divisible by the stride.
        """
        if images.ndim != 5 or images.shape[2] != self.encoder.input_channels:
            check_shape(images, f"B N {self.encoder.input_channels} H W", "images")
        if images.shape[-2] % self.stride or images.shape[-1] % self.stride:
            raise ShapeError(
                f"expected images with sides divisible by {self.stride}, got {tuple(images.shape[-2:])}"
            )
        scaled = images.flatten(0, 1).to(self.image_mean.dtype)
        if not images.is_floating_point():
            scaled = scaled / 255
        normalized = (scaled - self.image_mean[:, None, None]) / self.image_std[:, None, None]
        return self.projection(self.encoder(normalized).movedim(1, -1))


class VoxelBackbone(nn.Module, ABC):
    """The interface of a backbone: what the model needs of it, here and in backbones of your own.

    Args:
        encoder: the image encoder.
        channels: C of the 2D and 3D representations.
    """

    def __init__(self, *, encoder: ImageEncoder, channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.image_features = ImageFeatures(encoder=encoder, channels=channels)

    @property
    def encoder(self) -> ImageEncoder:
        """The image encoder."""
        return self.image_features.encoder

    @property
    def stride(self) -> int:
        """Image pixels along each side of a feature cell."""
        return self.encoder.stride

    @abstractmethod
    def trace(
        self,
        cameras: Cameras,
        grid: VoxelGrid,
        feature_size: tuple[int, int],
        *,
        ray_tracer: Callable[..., Pairs],
        rays_per_cell: int,
    ) -> Pairs:
        """Return the pairs of pixels and voxels that exchange features.

        Args:
            cameras: of leading shape ``(B, N)``.
            grid: the voxel grids, ``center`` ``(B, 3)``.
            feature_size: ``(h, w)`` of the feature maps.
            ray_tracer: finds the pairs that a ray joins.
            rays_per_cell: n, for n×n rays through each cell.
        """

    @abstractmethod
    def forward(
        self,
        images: Sequence[Tensor],
        cameras: Sequence[Cameras],
        grid: VoxelGrid,
        pairs: Sequence[Pairs],
        *,
        with_pixels: bool = True,
    ) -> tuple[Tensor, list[Tensor] | None]:
        """Return features of the scene and of its views.

        The views of a scene come in chunks, one in training. A prediction from many views takes a few at a
        time: the same result up to rounding, in less memory. Of all views only the pairs and the pixel
        features are kept.

        Args:
            images: for each chunk of views ``(B, N, 3 or 4, H, W)`` uint8, or floating point in [0, 1].
            cameras: of each chunk, of leading shape ``(B, N)``.
            grid: the voxel grids, ``center`` ``(B, 3)``.
            pairs: of each chunk, for all B scenes and feature maps of ``H/stride × W/stride``.
            with_pixels: False leaves out what only pixel features need.

        Returns:
            voxel features ``(B, X, Y, Z, C)``, and pixel features ``(B, N, h, w, C)`` of each chunk or None.

        Raises:
            ConfigError: several chunks in training mode, where batch normalisation needs all views together.
            ShapeError: images have other channels than the encoder, or sides not divisible by the stride.
        """

    def idle_modules(self, *, with_pixels: bool) -> tuple[str, ...]:
        """Return the names of the sub-modules that no gradient of ``forward`` reaches."""
        return ("image_features.encoder",) if self.encoder.frozen else ()

    def refuse_chunks_in_training(self, chunks: Sequence[object]) -> None:
        """Raise if the network is in training mode and there are several chunks of views.

        Raises:
            ConfigError: they are, and it is.
        """
        if self.training and len(chunks) > 1:
            raise ConfigError(
                "views in several chunks need a network in evaluation mode: leave out views_at_once"
            )


class Backbone(VoxelBackbone):
    """2D features per view, averaged into voxels, then ``num_blocks`` 2D⇔3D blocks of ray-traced attention.

    Args:
        encoder: the image encoder.
        channels: C of the 2D and 3D representations.
        num_heads: attention heads of each block.
        num_blocks: number of blocks n.
        expansion: hidden channels of the blocks' feed-forwards, as a multiple of C.
        bidirectional: False leaves out 3D→2D: no block changes the pixels (an ablation).
        voxel_network: called with ``channels=C``, returns a network that voxel features ``(B, X, Y, Z, C)``
            pass before the first block; None for none, as in the paper.
        checkpoint_blocks: in training keep only what enters each block and compute the rest again for the
            backward pass: the same gradients, less memory, a forward pass of the blocks more.

    Raises:
        ConfigError: ``channels`` is not a multiple of ``num_heads``, or there is no block.
    """

    def __init__(
        self,
        *,
        encoder: ImageEncoder,
        channels: int = 256,
        num_heads: int = 8,
        num_blocks: int = 4,
        expansion: int = 2,
        bidirectional: bool = True,
        voxel_network: Callable[..., nn.Module] | None = None,
        checkpoint_blocks: bool = False,
    ) -> None:
        super().__init__(encoder=encoder, channels=channels)
        if channels % num_heads or num_blocks < 1:
            raise ConfigError(
                "backbone needs channels divisible by num_heads and num_blocks of at least 1, got "
                f"{channels} channels, {num_heads} heads, {num_blocks} blocks"
            )
        self.bidirectional = bidirectional
        self.checkpoint_blocks = checkpoint_blocks
        self.voxel_position = nn.Linear(channels, channels)
        self.ray_position = nn.Sequential(nn.Linear(6, channels), nn.GELU(), nn.Linear(channels, channels))
        self.unseen = nn.Parameter(0.02 * torch.randn(channels))
        self.blocks = nn.ModuleList(
            RayTracedBlock(channels=channels, num_heads=num_heads, expansion=expansion)
            for _ in range(num_blocks)
        )
        self.voxel_norm = LayerNorm(channels)
        self.pixel_norm = LayerNorm(channels)
        # Made last, so that the other parts start from the same weights with and without it.
        self.voxel_network = nn.Identity() if voxel_network is None else voxel_network(channels=channels)

    def trace(
        self,
        cameras: Cameras,
        grid: VoxelGrid,
        feature_size: tuple[int, int],
        *,
        ray_tracer: Callable[..., Pairs],
        rays_per_cell: int,
    ) -> Pairs:
        """Return the pairs of pixels and voxels that exchange features: those that a ray joins."""
        return ray_tracer(cameras, grid, feature_size, rays_per_cell)

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
        pixels = []
        for chunk, of_chunk in zip(images, cameras, strict=True):
            features = self.image_features(chunk)
            pixels.append(features + self.ray_position(ray_code(of_chunk, grid, features.shape[1:3])))
        mean, is_seen = splat_in_chunks([features.flatten(0, 2) for features in pixels], pairs)
        voxels = self._start_voxels(mean, is_seen, grid)
        for index, block in enumerate(self.blocks):
            update_pixels = self._updates_pixels(index, with_pixels=with_pixels)
            voxels, pixels = self._run_block(block, voxels, pixels, pairs, update_pixels)
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
        still = [i for i in range(len(self.blocks)) if not self._updates_pixels(i, with_pixels=with_pixels)]
        blocks = tuple(f"blocks.{index}.pixel_stream" for index in still)
        return (*idle, *blocks) if with_pixels else (*idle, "pixel_norm", *blocks)

    def _start_voxels(self, mean: Tensor, is_seen: Tensor, grid: VoxelGrid) -> Tensor:
        """Return V⁰ with positions, ``(B, X, Y, Z, C)``; voxels that no ray crosses have one embedding."""
        voxels = torch.where(is_seen[:, None], mean, self.unseen.to(mean.dtype))
        voxels = voxels.view(-1, *grid.resolution, self.channels) + self._voxel_positions(grid)
        return self.voxel_network(voxels)

    def _voxel_positions(self, grid: VoxelGrid) -> Tensor:
        """Return the position embedding of the voxels, ``(X, Y, Z, C)``; that of every scene is the same."""
        like, shape = self.unseen, (grid.resolution, grid.extent)  # of the projection there may be 16 bits
        code = voxel_code(*shape, grid.extent, self.channels, like.dtype, device=like.device)
        return self.voxel_position(code)

    def _updates_pixels(self, index: int, *, with_pixels: bool) -> bool:
        """Say whether block ``index`` changes the pixels: of the last one only pixel features need it."""
        is_read = with_pixels or index + 1 < len(self.blocks)
        return self.bidirectional and is_read

    def _run_block(
        self,
        block: nn.Module,
        voxels: Tensor,
        pixels: Sequence[Tensor],
        pairs: Sequence[Pairs],
        update_pixels: bool,
    ) -> tuple[Tensor, list[Tensor]]:
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
