# SPDX-License-Identifier: Apache-2.0
"""Exact traversal of the voxel grid: which voxels does the ray of each pixel pass through (RayTran §3.1).

A voxel is entered through one of its faces. So the voxels along a ray are those behind each of its crossings
with the grid's planes (as in Amanatides & Woo, "A fast voxel traversal algorithm", 1987, whose steps are here
taken all at once), and the voxel in which it begins.

Rule for ties. A voxel counts if the ray runs through its inside for more than ``NUDGE``; voxels that it only
touches, along an edge or at a corner, do not count. A ray that runs inside a face, parallel to an axis,
belongs to the voxel on the side of the larger coordinate: cells are half-open, [i, i+1), and so is the whole
grid. A camera within ``NUDGE`` of a plane of the grid stands on it, so that rounding decides none of this.
"""

from __future__ import annotations

import torch
from torch import Tensor

from raytran.errors import ShapeError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList

NUDGE = 1e-9
"""Lengths below this count as zero: metres of depth along a ray, and sizes of a voxel for positions."""

_PARALLEL = 1e-12
"""Slopes below this, in voxels per metre of depth, count as zero."""

_RAYS_AT_ONCE = {"cpu": 1 << 12}
_RAYS_AT_ONCE_ELSEWHERE = 1 << 17
"""Rays traced together: few enough on a CPU that the work stays in its cache."""


@torch.no_grad()
def trace_pairs(
    cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int] = (30, 40), rays_per_cell: int = 2
) -> PairList:
    """Return the pairs of pixels and voxels that a ray joins.

    Rays run from the camera outwards (depth > 0) and have no end. Computed in float64.

    Args:
        cameras: cameras of leading shape ``(N,)``, or ``(B, N)`` for a batch of scenes.
        grid: the voxel grid, ``center`` ``(3,)``, or ``(B, 3)`` for a batch.
        feature_size: ``(h, w)`` of the feature map laid over each image.
        rays_per_cell: n; a pixel casts n×n rays and is paired with every voxel that one of them crosses.

    Returns:
        One list for the whole batch, on the device of the cameras.

    Raises:
        ShapeError: cameras and grid have other leading shapes.
    """
    origins, directions = _rays_in_grid(cameras, grid, feature_size, rays_per_cell)
    scenes, views = directions.shape[:2]
    num_pixels = scenes * views * feature_size[0] * feature_size[1]
    rays_per_pixel = rays_per_cell**2
    origins, directions = origins.expand_as(directions).reshape(-1, 3), directions.reshape(-1, 3)

    at_once = _RAYS_AT_ONCE.get(directions.device.type, _RAYS_AT_ONCE_ELSEWHERE)
    step = max(1, at_once // rays_per_pixel)
    pixel_index, voxel_index = [], []
    for first in range(0, num_pixels, step):
        chunk = slice(first * rays_per_pixel, (first + step) * rays_per_pixel)
        key = _trace(
            origins[chunk].T.contiguous(), directions[chunk].T.contiguous(), grid.resolution, rays_per_pixel
        )
        pixel = key.div(grid.num_voxels, rounding_mode="floor")
        voxel_index.append((key - pixel * grid.num_voxels).long())
        pixel_index.append(pixel.long() + first)
    pixels, voxels = torch.cat(pixel_index), torch.cat(voxel_index)
    if scenes > 1:
        voxels += pixels.div(num_pixels // scenes, rounding_mode="floor") * grid.num_voxels
    return PairList(pixels, voxels, num_pixels=num_pixels, num_voxels=scenes * grid.num_voxels)


def _rays_in_grid(
    cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int
) -> tuple[Tensor, Tensor]:
    """Return origins ``(B, N, 1, 3)`` and directions ``(B, N, rays of a view, 3)`` in voxel coordinates."""
    lead, scenes = cameras.intrinsics.shape[:-2], grid.center.shape[:-1]
    if len(lead) not in (1, 2) or (scenes != () and scenes != lead[:-1]):
        raise ShapeError(
            "expected cameras of leading shape (N,) or (B, N) and a grid center of shape (3,) or (B, 3), "
            f"got {tuple(lead)} and {tuple(grid.center.shape)}"
        )
    precise = Cameras(cameras.intrinsics.double(), cameras.world_from_camera.double(), cameras.image_size)
    _, directions = precise.cell_rays(feature_size, rays_per_cell)
    grid = VoxelGrid(grid.resolution, grid.extent, grid.center.double().to(directions.device))
    origins = grid.voxel_from_world(precise.position)[..., None, :]
    directions = (directions / grid.voxel_size).flatten(-4, -2)
    origins = torch.where((origins - origins.round()).abs() < NUDGE, origins.round(), origins)
    directions = directions.masked_fill_(directions.abs() < _PARALLEL, 0.0)
    return (origins[None], directions[None]) if len(lead) == 1 else (origins, directions)


def _trace(
    origin: Tensor, direction: Tensor, resolution: tuple[int, int, int], rays_per_pixel: int
) -> Tensor:
    """Return ``pixel · num_voxels + voxel`` of the pairs of some pixels, sorted, each once.

    Args:
        origin: ``(3, R)`` in voxel coordinates.
        direction: ``(3, R)`` in voxels per metre of depth; the rays of a pixel follow one another.
        resolution: ``(X, Y, Z)``.
        rays_per_pixel: how many rays that is.
    """
    num_voxels = resolution[0] * resolution[1] * resolution[2]
    pixel = torch.arange(origin.shape[1] // rays_per_pixel, dtype=origin.dtype, device=origin.device)
    base = pixel.repeat_interleave(rays_per_pixel) * num_voxels
    first, last = _clip(origin, direction, resolution)
    found = [(base + _start(origin, direction, resolution))[(first == 0) & (last > NUDGE)]]
    for axis in range(3):
        depth, voxel = _entered(axis, origin, direction, resolution)
        found.append(voxel.add_(base)[(depth > first) & (depth < last)])
    wide = num_voxels * origin.shape[1] >= 2**31
    keys = torch.cat(found).to(torch.int64 if wide else torch.int32)
    return torch.unique_consecutive(keys.sort().values)


def _clip(origin: Tensor, direction: Tensor, resolution: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Return the depths at which rays enter (≥ 0) and leave the grid, ``(R,)`` each; leave ≤ enter: miss."""
    size = torch.tensor(resolution, dtype=origin.dtype, device=origin.device)[:, None]
    lower, upper = -origin / direction, (size - origin) / direction
    parallel, inside = direction == 0, (origin >= 0) & (origin < size)
    near = torch.where(parallel, torch.where(inside, -torch.inf, torch.inf), torch.minimum(lower, upper))
    far = torch.where(parallel, torch.inf, torch.maximum(lower, upper))
    return near.amax(0).clamp_(min=0), far.amin(0)


def _start(origin: Tensor, direction: Tensor, resolution: tuple[int, int, int]) -> Tensor:
    """Return the voxel in which each ray begins, ``(R,)``; without meaning for cameras outside the grid."""
    index = torch.where(direction < 0, origin.ceil() - 1, origin.floor())
    return (index[0] * resolution[1] + index[1]) * resolution[2] + index[2]


def _entered(
    axis: int, origin: Tensor, direction: Tensor, resolution: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """Return the voxels that each ray enters across one axis and a depth just behind the crossing.

    Both are ``(n, R)`` for the ``n`` cells along the axis: into cell i a ray comes through the plane i, or
    i + 1 if it runs backwards. Outside the grid they have no meaning.
    """
    strides = (resolution[1] * resolution[2], resolution[2], 1)
    cell = torch.arange(resolution[axis], dtype=origin.dtype, device=origin.device)[:, None]
    slope = 1 / direction[axis]
    backwards = (direction[axis] < 0).to(origin.dtype)
    depth = torch.addcmul((backwards - origin[axis]) * slope + NUDGE, cell, slope)
    voxel = (cell * strides[axis]).expand_as(depth)
    for other in range(3):
        if other != axis:
            index = torch.addcmul(origin[other], direction[other], depth).floor_()
            # A crossing that counts is inside the grid; rounding must not say otherwise.
            voxel = voxel + index.clamp_(0, resolution[other] - 1).mul_(strides[other])
    return depth, voxel
