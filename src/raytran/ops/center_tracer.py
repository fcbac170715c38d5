# SPDX-License-Identifier: Apache-2.0
"""Pairs of a voxel and the pixels under its centre, as other methods join them (Atlas, ImVoxelNet)."""

from __future__ import annotations

import torch

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList


def pair_centers(cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int]) -> PairList:
    """Join each voxel, in each view that has its centre in the image, with the cell that the centre falls on.

    So a voxel has at most one pixel a view, whatever it covers of the image, and the mean over its pairs is
    the unprojection of ImVoxelNet (Rukhovich et al., WACV 2022).

    Args:
        cameras: of leading shape ``(N,)`` or ``(B, N)``.
        grid: the voxel grids, ``center`` ``(3,)`` or ``(B, 3)``.
        feature_size: ``(h, w)`` of the feature maps.
    """
    height, width = feature_size
    centers = grid.voxel_centers().flatten(-4, -2).to(cameras.intrinsics.dtype)
    place, depth = cameras.scaled_to(feature_size).project(centers[..., None, :, :])
    inside = (place >= 0).all(dim=-1) & (place[..., 0] < width) & (place[..., 1] < height) & (depth > 0)
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


class CenterTracer:
    """Stands where a ``RayTracer`` does, for backbones that unproject."""

    @torch.compiler.disable
    def __call__(
        self, cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int
    ) -> PairList:
        """Return the pairs of ``pair_centers``, with both orders made; ``rays_per_cell`` means nothing."""
        pairs = pair_centers(cameras, grid, feature_size)
        pairs.by("pixels"), pairs.by("voxels")
        return pairs
