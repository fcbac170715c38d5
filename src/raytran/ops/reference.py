# SPDX-License-Identifier: Apache-2.0
"""The obvious, slow twins of the operations in this folder, under the same names, for tests and readers."""

from __future__ import annotations

import torch
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import Direction


def pair_mask(pairs: PairList) -> Tensor:
    """Return the pairs as a dense matrix, bool ``(num_pixels, num_voxels)``."""
    mask = torch.zeros(pairs.num_pixels, pairs.num_voxels, dtype=torch.bool, device=pairs.pixel_index.device)
    mask[pairs.pixel_index, pairs.voxel_index] = True
    return mask


def ray_attention(
    query: Tensor, key: Tensor, value: Tensor, pairs: PairList, direction: Direction = "pixels_to_voxels"
) -> Tensor:
    """Compute ``raytran.ops.ray_attention.ray_attention`` by the whole score matrix, ``(H, T, S)``."""
    mask = pair_mask(pairs)
    mask = mask.T if direction == "pixels_to_voxels" else mask
    score = torch.einsum("thd,shd->hts", query, key) / query.shape[-1] ** 0.5
    # exp(score) over the pairs alone; a target with no pair divides 0 by 1.
    score = score.masked_fill(~mask, -torch.inf)
    peak = score.amax(dim=2, keepdim=True).clamp(min=torch.finfo(score.dtype).min).detach()
    weight = (score - peak).exp()
    weight = weight / weight.sum(dim=2, keepdim=True).where(mask.any(dim=1)[:, None], 1.0)
    return torch.einsum("hts,shd->thd", weight, value)


def splat_features(features: Tensor, pairs: PairList) -> tuple[Tensor, Tensor]:
    """Compute ``raytran.ops.splat.splat_features`` by a matrix product."""
    weight = pair_mask(pairs).T.to(features.dtype)
    count = weight.sum(dim=1, keepdim=True)
    return weight @ features / count.clamp(min=1), count[:, 0] > 0


def trace_pairs(
    cameras: Cameras,
    grid: VoxelGrid,
    feature_size: tuple[int, int],
    rays_per_cell: int = 2,
    min_depth: float = 1e-9,
) -> PairList:
    """Compute ``raytran.ops.traverse.trace_pairs`` of one scene by testing each ray against each voxel.

    A ray is inside a slab between two planes over an interval of depth, inside a voxel over the intersection
    of three of them, and the voxel counts if that is longer than ``min_depth`` metres in front of the camera.
    A ray parallel to a slab is in it for ever or never; slabs are half-open. A ray outside of its camera's
    picture is in no voxel.
    """
    precise = cameras.to(torch.float64)
    directions = precise.cell_rays(feature_size, rays_per_cell)[1].flatten(0, 2)
    pixels_of_view = feature_size[0] * feature_size[1]
    device = directions.device
    precise_grid = VoxelGrid(grid.resolution, grid.extent, grid.center.double().to(device))
    corner, size = precise_grid.lower, precise_grid.voxel_size
    index = torch.cartesian_prod(*(torch.arange(n, device=device) for n in grid.resolution)).reshape(-1, 3)
    lower, upper = corner + index * size, corner + (index + 1) * size
    pixels, voxels = [], []
    for pixel, rays in enumerate(directions):
        origin = precise.position[pixel // pixels_of_view]
        crossed = torch.zeros(len(index), dtype=torch.bool, device=device)
        for number, ray in enumerate(rays):
            if _in_picture(precise, pixel, number, feature_size, rays_per_cell):
                crossed |= _depth_inside(origin, ray, lower, upper) > min_depth
        found = crossed.nonzero()[:, 0]
        pixels.append(torch.full_like(found, pixel))
        voxels.append(found)
    return PairList(torch.cat(pixels), torch.cat(voxels), len(directions), grid.num_voxels)


def _in_picture(
    cameras: Cameras, pixel: int, number: int, feature_size: tuple[int, int], rays_per_cell: int
) -> bool:
    """Return whether ray ``number`` of a pixel of the pair list passes through its camera's picture."""
    if cameras.picture is None:
        return True
    view, cell = divmod(pixel, feature_size[0] * feature_size[1])
    place = zip(divmod(cell, feature_size[1]), divmod(number, rays_per_cell), feature_size, strict=True)
    row, column = (index + (part + 0.5) / rays_per_cell for index, part, _ in place)
    v, u = row / feature_size[0] * cameras.image_size[0], column / feature_size[1] * cameras.image_size[1]
    left, top, right, bottom = cameras.picture[view].tolist()
    return bool(left <= u < right and top <= v < bottom)


def _depth_inside(origin: Tensor, ray: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return over how much depth a ray is inside each of some boxes, ``(boxes,)``; negative if it misses."""
    near = lower.new_zeros(len(lower))
    far = torch.full_like(near, torch.inf)
    for axis in range(3):
        low, high = lower[:, axis], upper[:, axis]
        if ray[axis].abs() < 1e-12:
            # Less than rounding below a face counts as on it, and so as in the slab above.
            outside = (origin[axis] < low - 1e-10) | (origin[axis] >= high - 1e-10)
            near = near.masked_fill(outside, torch.inf)
            far = far.masked_fill(outside, 0.0)
            continue
        ends = torch.stack([low - origin[axis], high - origin[axis]]) / ray[axis]
        near, far = torch.maximum(near, ends.amin(0)), torch.minimum(far, ends.amax(0))
    return far - near
