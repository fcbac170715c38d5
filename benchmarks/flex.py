# SPDX-License-Identifier: Apache-2.0
"""The strongest baseline: FlexAttention, whose mask tests rays against voxels in the kernel.

Its block mask lists the 128×128 blocks of the attention matrix in which there is a pair; inside of them a
slab test of each ray of a pixel against a voxel's box says which pairs there are. In float32.

Compiled anew for each case and for its sizes alone: one compiled function for all of them passes torch's
limit of recompilations and then runs uncompiled, which makes the whole matrix and is no FlexAttention.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.attention.flex_attention import BlockMask, flex_attention

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import Direction
from raytran.ops.traverse import voxel_rays

BLOCK = 128


def flex_ray_attention(
    pairs: PairList,
    cameras: Cameras,
    grid: VoxelGrid,
    feature_size: tuple[int, int],
    direction: Direction,
    rays_per_cell: int = 2,
) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """Return attention of ``query (T, H, D)`` to ``key, value (S, H, D)`` along the rays.

    Args:
        pairs: the pairs, for the list of blocks.
        cameras: of N views.
        grid: the volume of one scene.
        feature_size: ``(h, w)``.
        direction: from the source to the target.
        rays_per_cell: n.
    """
    target, source = pairs.voxel_index, pairs.pixel_index
    targets, sources = pairs.num_voxels, pairs.num_pixels
    if direction == "voxels_to_pixels":
        target, source, targets, sources = source, target, sources, targets
    mask = _block_mask(
        target, source, targets, sources, _meets(cameras, grid, feature_size, direction, rays_per_cell)
    )

    torch._dynamo.reset()
    # fullgraph: what cannot be compiled raises instead of running as it is.
    compiled = torch.compile(flex_attention, fullgraph=True, dynamic=False)

    def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        heads_first = (x.transpose(0, 1)[None] for x in (query, key, value))
        return compiled(*heads_first, block_mask=mask)[0].transpose(0, 1)

    return attend


def _block_mask(
    target: Tensor, source: Tensor, targets: int, sources: int, meets: Callable[..., Tensor]
) -> BlockMask:
    rows, columns = -(-targets // BLOCK), -(-sources // BLOCK)
    touched = torch.zeros(rows, columns, dtype=torch.bool, device=target.device)
    touched[target // BLOCK, source // BLOCK] = True
    number = touched.sum(dim=1, dtype=torch.int32)
    # The blocks of a row first, in their order; what stands behind them is not read.
    indices = touched.int().argsort(dim=1, descending=True, stable=True).int()
    return BlockMask.from_kv_blocks(
        number[None, None],
        indices[None, None],
        BLOCK_SIZE=BLOCK,
        mask_mod=meets,
        seq_lengths=(targets, sources),
    )


def _meets(
    cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], direction: Direction, rays_per_cell: int
) -> Callable[..., Tensor]:
    origin, ray = voxel_rays(cameras, grid, feature_size, rays_per_cell)
    origin = origin.float().reshape(-1, 3).contiguous()
    slope = ray.float().reciprocal().clamp(-1e12, 1e12).reshape(-1, 3).contiguous()
    cells, per_cell = feature_size[0] * feature_size[1], rays_per_cell**2
    _, y, z = grid.resolution

    def meets(batch: Tensor, head: Tensor, target: Tensor, source: Tensor) -> Tensor:
        voxel, pixel = (target, source) if direction == "pixels_to_voxels" else (source, target)
        index = (voxel // (y * z), voxel // z % y, voxel % z)
        view = pixel // cells
        hit = voxel < 0
        for number in range(per_cell):
            near, far = 0.0 * slope[0, 0], 3e38 + 0.0 * slope[0, 0]
            for axis in range(3):
                first = (index[axis] - origin[view, axis]) * slope[pixel * per_cell + number, axis]
                second = first + slope[pixel * per_cell + number, axis]
                near = torch.maximum(near, torch.minimum(first, second))
                far = torch.minimum(far, torch.maximum(first, second))
            hit = hit | (far - near > 1e-6)
        return hit

    return meets
