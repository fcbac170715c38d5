# SPDX-License-Identifier: Apache-2.0
"""Traversal on a GPU: from the cameras straight to block pairs.

It finds the same pairs as ``trace_pairs`` but never lists them. First every ray is tested against every
block of voxels, then the rays of each tile that touches a block against its voxels. At the paper's size that
is 118 million slab tests of blocks and, with 19,100 block pairs, 78 million of voxels. At 62 and 57
instructions each, counted in the code for an H200, they are 370 million instructions of a warp, 0.4 ms if all
its schedulers are busy; the bytes (4 MB of rays, 5 MB of masks, 1 MB of marks) take less than 10 µs, and some
hundred small launches for the rays and the orders 0.5 ms. Reckoned, not measured. Work grows linearly with
views. None of these instructions is one of float64, which on the paths of two scans no tile needed.

How many block pairs there are only the GPU knows: the host waits for their number, or gives a capacity.
"""

from __future__ import annotations

import torch
import triton
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.traverse import NUDGE, voxel_rays
from raytran.ops.triton.block_pairs import BlockPairs
from raytran.ops.triton.tiling import ROW, Tiling
from raytran.ops.triton.traverse_kernels import list_blocks, mask_blocks, touch_blocks

_BLOCKS_AT_ONCE = 32


@torch.no_grad()
def trace_blocks(
    cameras: Cameras,
    grid: VoxelGrid,
    feature_size: tuple[int, int] = (30, 40),
    rays_per_cell: int = 2,
    *,
    capacity: int | None = None,
) -> tuple[BlockPairs, Tensor]:
    """Return the pairs of ``trace_pairs`` as block pairs.

    Args:
        cameras: as in ``trace_pairs``.
        grid: as in ``trace_pairs``.
        feature_size: as in ``trace_pairs``.
        rays_per_cell: as in ``trace_pairs``.
        capacity: how many block pairs there is room for; None makes room for all of them, for which the host
            waits for the GPU.

    Returns:
        the block pairs, and their number ``()`` int64 on the GPU. If it is above ``capacity``, the last are
        missing.

    Raises:
        ShapeError: cameras and grid have other leading shapes.
    """
    origin, direction = voxel_rays(cameras, grid, feature_size, rays_per_cell)
    views, scenes = origin.shape[:-1].numel(), origin.shape[:-2].numel()
    pixels = Tiling.of_pixels(views * feature_size[0] * feature_size[1], (views, *feature_size))
    voxels = Tiling.of_voxels(scenes * grid.num_voxels, (scenes, *grid.resolution))
    slope = direction.reciprocal().masked_fill_(direction == 0, 0.0)
    rays = (origin.contiguous(), slope.contiguous(), slope.float().contiguous()), pixels.starts(origin.device)
    with torch.cuda.device_of(origin):
        return _trace(rays, pixels, voxels, rays_per_cell**2, capacity)


def _trace(
    rays: tuple[tuple[Tensor, Tensor, Tensor], Tensor],
    pixels: Tiling,
    voxels: Tiling,
    rays_per_pixel: int,
    capacity: int | None,
) -> tuple[BlockPairs, Tensor]:
    """Return the block pairs and their number; ``rays`` as the kernels take them and the tiles' pixels."""
    tiles, blocks, scenes = pixels.num_tiles, voxels.num_tiles, voxels.shape[0]
    blocks_of_scene, device = blocks // scenes, rays[1].device
    touched = torch.empty(tiles, blocks_of_scene, dtype=torch.int8, device=device)
    grid = tiles, triton.cdiv(blocks_of_scene, _BLOCKS_AT_ONCE)
    boxes = [(tiling.tile, tiling.part, tiling.shape[1:]) for tiling in (pixels, voxels)]
    touch_blocks[grid](*rays, touched, blocks_of_scene, *boxes, rays_per_pixel, _BLOCKS_AT_ONCE, NUDGE)
    last = touched.sum(dim=1, dtype=torch.int64).cumsum(0)
    first = torch.nn.functional.pad(last[:-1], (1, 0))
    capacity = int(last[-1]) if capacity is None else capacity
    keys = torch.full((capacity,), tiles * blocks, dtype=torch.int64, device=device)
    masks = torch.empty(capacity, 2, ROW, dtype=torch.int32, device=device)
    if capacity:
        list_blocks[tiles,](
            touched, first, keys, capacity, blocks_of_scene, tiles // scenes, blocks, _BLOCKS_AT_ONCE
        )
        sizes = tiles, blocks_of_scene, blocks
        mask_blocks[capacity,](*rays, keys, masks, *sizes, *boxes, rays_per_pixel, NUDGE)
    return BlockPairs(keys, masks, pixels, voxels), last[-1]
