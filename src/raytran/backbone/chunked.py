# SPDX-License-Identifier: Apache-2.0
"""The backbone in bounded memory: views pass through it a few at a time (prediction only).

A view's pixels attend to voxels alone, so they need no other view. A voxel attends to the pixels of all
views: its softmax is put together from those over the views of each chunk, weighted by their sums of
exponentials (the online softmax of Milakov & Gimelshein, 2018). So the result is that of all views at once
up to rounding, and besides the voxels only the pixel features themselves grow with the number of views.
Pairs are traced again wherever a chunk is needed, which costs far less than to keep them all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import torch
from torch import Tensor

from raytran.backbone.block import RayTracedBlock
from raytran.backbone.lifting import LiftingBackbone
from raytran.errors import ConfigError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import ray_attention, ray_attention_with_sum
from raytran.ops.splat import splat_features
from raytran.ops.triton.block_pairs import BlockPairs

Trace = Callable[[Cameras], PairList | BlockPairs]
"""From the cameras ``(B, n)`` of a few views to their pixel-voxel pairs."""


@torch.no_grad()
def run_in_chunks(
    backbone: LiftingBackbone,
    images: Tensor,
    cameras: Cameras,
    grid: VoxelGrid,
    trace: Trace,
    *,
    views_at_once: int,
    with_pixels: bool = True,
) -> tuple[Tensor, Tensor | None]:
    """Return what ``LiftingBackbone.forward`` returns, ``views_at_once`` views of each scene at a time.

    Args:
        backbone: in evaluation mode.
        images: ``(B, N, 3 or 4, H, W)``.
        cameras: of leading shape ``(B, N)``.
        grid: the voxel grids, ``center`` ``(B, 3)``.
        trace: the pixel-voxel pairs of some views.
        views_at_once: views of a scene in a chunk.
        with_pixels: return pixel features too.

    Raises:
        ConfigError: the backbone is in training mode, where batch normalisation needs all views together, or
            ``views_at_once`` is not positive.
        ShapeError: images do not have the documented shape.
    """
    if backbone.training or views_at_once < 1:
        raise ConfigError(
            f"views_at_once={views_at_once} needs a number above 0 and a network in evaluation mode: "
            "leave it out in training"
        )
    chunks = [slice(start, start + views_at_once) for start in range(0, images.shape[1], views_at_once)]
    cameras_of = [cameras.select(chunk) for chunk in chunks]
    views = [images[:, chunk] for chunk in chunks]
    voxels, pixels = _start(backbone, views, cameras_of, grid, trace)
    for index, block in enumerate(backbone.blocks):
        update_pixels = backbone.updates_pixels(index, with_pixels=with_pixels)
        voxels = _run_block(
            cast("RayTracedBlock", block), voxels, pixels, cameras_of, trace, update_pixels=update_pixels
        )
    if not with_pixels:
        return backbone.voxel_norm(voxels), None
    normalized = [backbone.pixel_norm(some).unflatten(0, (images.shape[0], -1)) for some in pixels]
    return backbone.voxel_norm(voxels), torch.cat(normalized, dim=1)


def _start(
    backbone: LiftingBackbone,
    images: Sequence[Tensor],
    cameras: Sequence[Cameras],
    grid: VoxelGrid,
    trace: Trace,
) -> tuple[Tensor, list[Tensor]]:
    """Return what enters the first block: the voxels, and the pixels of each chunk."""
    total = backbone.projection.weight.new_zeros(len(images[0]) * grid.num_voxels, backbone.channels)
    count = total.new_zeros(len(total), dtype=torch.int64)
    pixels: list[Tensor] = []
    for chunk, some in zip(images, cameras, strict=True):
        pixels.append(backbone.embed(chunk, some, grid))
        pairs = trace(some)
        mean, _ = splat_features(pixels[-1].flatten(0, 2), pairs)
        met = pairs.pixels_per_voxel()
        total += mean.to(total.dtype) * met[:, None]
        count += met
    splatted = (total / count.clamp(min=1)[:, None]).to(pixels[0].dtype)
    return backbone.start_voxels(splatted, count > 0, grid), pixels


def _run_block(
    block: RayTracedBlock,
    voxels: Tensor,
    pixels: list[Tensor],
    cameras: Sequence[Cameras],
    trace: Trace,
    *,
    update_pixels: bool,
) -> Tensor:
    """Return the voxels after the block; the pixel features of each chunk are replaced in their list."""
    to_voxels, to_pixels = block.voxel_stream, block.pixel_stream
    voxel_input = block.voxel_norm(voxels)
    query = to_voxels.heads(to_voxels.query(voxel_input))
    voxel_key, voxel_value = to_pixels.keys_and_values(voxel_input)
    softmax = _OnlineSoftmax(query)
    for index, (features, some) in enumerate(zip(pixels, cameras, strict=True)):
        pairs, pixel_input = trace(some), block.pixel_norm(features)
        key, value = to_voxels.keys_and_values(pixel_input)
        softmax.add(*ray_attention_with_sum(query, key, value, pairs))
        if update_pixels:
            pixel_query = to_pixels.heads(to_pixels.query(pixel_input))
            attended = ray_attention(pixel_query, voxel_key, voxel_value, pairs, "voxels_to_pixels")
            pixels[index] = to_pixels.finish(features, attended)
    return to_voxels.finish(voxels, softmax.mean.to(query.dtype))


class _OnlineSoftmax:
    """Joins attention over disjoint sets of sources into that over all of them.

    Args:
        query: ``(T, H, D)``, for its shape and device.
    """

    def __init__(self, query: Tensor) -> None:
        dtype = torch.promote_types(query.dtype, torch.float32)
        self.mean = torch.zeros(query.shape, dtype=dtype, device=query.device)
        self._log_weight = query.new_full(query.shape[:2], -torch.inf, dtype=dtype)

    def add(self, mean: Tensor, log_weight: Tensor) -> None:
        """Join the result ``(T, H, D)`` over more sources, of weight ``exp(log_weight)`` ``(T, H)``."""
        together = torch.logaddexp(self._log_weight, log_weight)
        # A target without a source so far: -inf minus -inf is no number, and its share of nothing is zero.
        share = torch.nan_to_num((log_weight - together).exp_())[..., None]
        self.mean.lerp_(mean.to(self.mean.dtype), share)
        self._log_weight = together
