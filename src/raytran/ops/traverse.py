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

from dataclasses import replace
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from raytran.errors import ConfigError, ShapeError, check_shape
from raytran.geometry.camera import Cameras
from raytran.geometry.double import place_with_double
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList, Pairs, interpreted, why_no_kernels
from raytran.structs import HostCopy

NUDGE = 1e-9
"""Lengths below this count as zero: metres of depth along a ray, and sizes of a voxel for positions."""

_PARALLEL = 1e-12
"""Slopes below this, in voxels per metre of depth, count as zero."""

_NO_RAY = 1e30
"""Voxels per metre of depth, along each axis, of a ray that is none: it is through the whole grid within a
depth far below ``NUDGE``, wherever it begins, so that nothing has to be taken out of lists of rays. Its
inverse is a number in float32 too."""

_VIEWS_AT_ONCE = 8
"""Views that are counted together."""

_LEAST_ROOM = 256
"""Block pairs for which there is always room."""

_AT_ONCE = {"cpu": 1 << 18}
_AT_ONCE_ELSEWHERE = 1 << 23
"""Crossings looked at together: on a CPU so few that they stay in its cache."""


class _Rays(NamedTuple):
    """Rays in voxel coordinates and voxels per metre of depth.

    Attributes:
        origin: ``(3, R)``.
        direction: ``(3, R)``.
        first: ``(R,)`` depth at which the ray enters the grid, at least 0.
        last: ``(R,)`` depth at which it leaves; not behind ``first``: it misses the grid.
    """

    origin: Tensor
    direction: Tensor
    first: Tensor
    last: Tensor


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
        One list for the whole batch, on the device of the cameras; for Apple's GPUs on the CPU, see
        ``place_with_double``.

    Raises:
        ShapeError: cameras and grid have other leading shapes.
    """
    cameras = cameras.to(place_with_double(cameras.intrinsics.device))
    origin, direction = voxel_rays(cameras, grid, feature_size, rays_per_cell)
    rays, scenes = _rays_in_grid(origin, direction, grid.resolution), origin.shape[:-2].numel()
    rays_per_pixel = rays_per_cell**2
    num_pixels = rays.first.shape[0] // rays_per_pixel
    at_once = _AT_ONCE.get(rays.first.device.type, _AT_ONCE_ELSEWHERE) // max(grid.resolution)
    pixels_at_once = max(1, at_once // rays_per_pixel)
    num_voxels = grid.num_voxels
    keys = []
    for pixel in range(0, num_pixels, pixels_at_once):
        chunk = slice(pixel * rays_per_pixel, (pixel + pixels_at_once) * rays_per_pixel)
        key = _trace(_Rays(*(part[..., chunk] for part in rays)), grid.resolution, rays_per_pixel)
        keys.append(key.long() + pixel * num_voxels)
    key = torch.cat(keys)
    pixel_index = key.div(num_voxels, rounding_mode="floor")
    voxel_index = key - pixel_index * num_voxels
    if scenes > 1:
        voxel_index += pixel_index.div(num_pixels // scenes, rounding_mode="floor") * num_voxels
    views = num_pixels // (feature_size[0] * feature_size[1])
    return PairList(
        pixel_index,
        voxel_index,
        num_pixels,
        scenes * num_voxels,
        pixel_shape=(views, *feature_size),
        voxel_shape=(scenes, *grid.resolution),
    )


@torch.no_grad()
def count_views(
    cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int] = (30, 40), rays_per_cell: int = 2
) -> Tensor:
    """Return how many views have a ray through each voxel, ``(X, Y, Z)`` int32.

    Args:
        cameras: the cameras of one scene, ``(N,)``; a few are traced at a time, so that memory does not grow.
        grid: its voxel grid, ``center`` ``(3,)``.
        feature_size: as in ``trace_pairs``.
        rays_per_cell: as in ``trace_pairs``.

    Raises:
        ShapeError: cameras or grid have other leading shapes.
    """
    check_shape(cameras.intrinsics, "N 3 3", "intrinsics")
    device = cameras.intrinsics.device
    cameras = cameras.to(place_with_double(device))
    counts = torch.zeros(grid.num_voxels, dtype=torch.int32, device=cameras.intrinsics.device)
    for start in range(0, len(cameras.intrinsics), _VIEWS_AT_ONCE):
        some = cameras[start : start + _VIEWS_AT_ONCE]
        pairs = trace_pairs(some, grid, feature_size, rays_per_cell)
        view = pairs.pixel_index.div(feature_size[0] * feature_size[1], rounding_mode="floor")
        met = torch.zeros(len(some.intrinsics), grid.num_voxels, dtype=torch.bool, device=counts.device)
        met[view, pairs.voxel_index] = True
        counts += met.sum(dim=0, dtype=torch.int32)
    return counts.view(grid.resolution).to(device)


def voxel_rays(
    cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int
) -> tuple[Tensor, Tensor]:
    """Return the rays of all pixels in voxel coordinates and voxels per metre of depth, float64.

    Slopes and offsets from the grid's planes that are nothing but rounding are zero. Rays that pass through
    no part of the picture (``Cameras.picture``) have the direction ``_NO_RAY``, which meets no voxel.

    Args:
        cameras: as in ``trace_pairs``.
        grid: as in ``trace_pairs``.
        feature_size: ``(h, w)``.
        rays_per_cell: n.

    Returns:
        origins ``(B, N, 3)`` and directions ``(B, N, h·w·n·n, 3)``, without B for cameras ``(N,)``.

    Raises:
        ShapeError: cameras and grid have other leading shapes.
    """
    lead, scenes = cameras.intrinsics.shape[:-2], grid.center.shape[:-1]
    if len(lead) not in (1, 2) or (scenes != () and scenes != lead[:-1]):
        raise ShapeError(
            "expected cameras of leading shape (N,) or (B, N) and a grid center of shape (3,) or (B, 3), "
            f"got {tuple(lead)} and {tuple(grid.center.shape)}"
        )
    precise = cameras.to(torch.float64)
    _, direction = precise.cell_rays(feature_size, rays_per_cell)
    grid = VoxelGrid(grid.resolution, grid.extent, grid.center.to(direction.device).double())
    direction = (direction / grid.voxel_size).flatten(-4, -2)
    direction = direction.masked_fill_(direction.abs() < _PARALLEL, 0.0)
    in_picture = precise.cells_in_picture(feature_size, rays_per_cell)
    if in_picture is not None:
        direction = direction.masked_fill_(~in_picture.flatten(-3)[..., None], _NO_RAY)
    origin = grid.voxel_from_world(precise.position)
    return torch.where((origin - origin.round()).abs() < NUDGE, origin.round(), origin), direction


def _rays_in_grid(origin: Tensor, direction: Tensor, resolution: tuple[int, int, int]) -> _Rays:
    """Return the rays of ``voxel_rays``, those of a pixel one after another, with where they are inside."""
    origin, direction = (
        part.reshape(-1, 3).T.contiguous() for part in (origin[..., None, :].expand_as(direction), direction)
    )
    return _Rays(origin, direction, *_clip(origin, direction, resolution))


def _clip(origin: Tensor, direction: Tensor, resolution: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Return at which depths rays enter and leave the grid: ``_Rays.first`` and ``_Rays.last``."""
    size = torch.tensor(resolution, dtype=origin.dtype, device=origin.device)[:, None]
    lower, upper = -origin / direction, (size - origin) / direction
    parallel, inside = direction == 0, (origin >= 0) & (origin < size)
    near = torch.where(parallel, torch.where(inside, -torch.inf, torch.inf), torch.minimum(lower, upper))
    far = torch.where(parallel, torch.inf, torch.maximum(lower, upper))
    return near.amax(0).clamp_(min=0), far.amin(0)


def _trace(rays: _Rays, resolution: tuple[int, int, int], rays_per_pixel: int) -> Tensor:
    """Return ``pixel · num_voxels + voxel`` of some pixels' pairs, sorted, each once; pixels count from 0."""
    num_rays, num_voxels = rays.first.shape[0], resolution[0] * resolution[1] * resolution[2]
    pixel = torch.arange(num_rays // rays_per_pixel, dtype=rays.first.dtype, device=rays.first.device)
    base = pixel.repeat_interleave(rays_per_pixel).mul_(num_voxels)
    found = [(_start(rays, resolution) + base)[(rays.first == 0) & (rays.last > NUDGE)]]
    for axis in range(3):
        depth, voxel = _entered(rays, axis, resolution)
        found.append(voxel.add_(base)[(depth > rays.first) & (depth < rays.last)])
    key = torch.cat(found).to(torch.int32 if num_rays * num_voxels < 2**31 else torch.int64)
    return torch.unique_consecutive(key.sort().values)


def _start(rays: _Rays, resolution: tuple[int, int, int]) -> Tensor:
    """Return the voxel in which each ray begins, ``(R,)``; without meaning for cameras outside the grid."""
    index = torch.where(rays.direction < 0, rays.origin.ceil() - 1, rays.origin.floor())
    return (index[0] * resolution[1] + index[1]) * resolution[2] + index[2]


def _entered(rays: _Rays, axis: int, resolution: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Return the voxels that each ray enters across one axis, and a depth just behind each crossing.

    Both are ``(n, R)`` for the ``n`` cells along the axis: into cell i a ray comes through the plane i, or
    i + 1 if it runs backwards. Outside the grid they have no meaning.
    """
    origin, direction = rays.origin, rays.direction
    strides = (resolution[1] * resolution[2], resolution[2], 1)
    cell = torch.arange(resolution[axis], dtype=origin.dtype, device=origin.device)[:, None]
    slope = direction[axis].reciprocal()
    backwards = (direction[axis] < 0).to(origin.dtype)
    depth = torch.addcmul((backwards - origin[axis]) * slope + NUDGE, cell, slope)
    voxel = cell * strides[axis]
    for other in range(3):
        if other != axis:
            index = torch.addcmul(origin[other], direction[other], depth).floor_()
            # A crossing that counts is inside the grid; rounding must not say otherwise.
            voxel = torch.add(voxel, index.clamp_(0, resolution[other] - 1), alpha=strides[other])
    return depth, voxel


Attention = Literal["auto", "fused", "sparse"]
"""By what ray-traced attention is computed: fused kernels where they run, fused kernels, or torch.sparse."""


class RayTracer:
    """Finds the pairs that rays join: block pairs for the fused kernels, a pair list for torch.sparse.

    Args:
        attention: ``auto`` chooses the fused kernels where they run, ``fused`` insists on them, ``sparse``
            does without.

    Raises:
        ConfigError: there is no such attention.
    """

    def __init__(self, attention: Attention = "auto") -> None:
        if attention not in get_args(Attention):
            raise ConfigError(
                f"unknown attention={attention}: choose one of {', '.join(get_args(Attention))}"
            )
        self.attention = attention
        self.fits: Tensor | None = None
        self._most: dict[tuple[int, ...], int] = {}
        self._coming: list[tuple[tuple[int, ...], HostCopy]] = []

    @torch.compiler.disable
    def __call__(
        self, cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int
    ) -> Pairs:
        """Return the pairs of ``trace_pairs``, with both orders and counts made; arguments are its own.

        Raises:
            ConfigError: ``attention`` is ``fused`` and the fused kernels do not run here.
        """
        self.fits = None
        pairs: Pairs
        if self._is_fused(cameras.intrinsics.device):
            # CPU installations of torch lack Triton: its module is imported only where it runs.
            from raytran.ops.triton.traverse import trace_blocks

            pairs, _ = trace_blocks(cameras, grid, feature_size, rays_per_cell)
            self._remember(_kind(cameras, grid, feature_size, rays_per_cell), len(pairs))
        else:
            pairs = trace_pairs(cameras, grid, feature_size, rays_per_cell)
            pairs = pairs if self.attention == "auto" else replace(pairs, fused=False)
        return _complete(pairs)

    @torch.compiler.disable
    def without_waiting(
        self, cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int
    ) -> Pairs:
        """Return the pairs without waiting for their number: there is room for twice the most so far.

        ``fits``, ``()`` bool on the device, then says whether that sufficed. If not, the last are missing
        and nothing may be learned from the rest. It is None where all are there for certain: without kernels,
        or when such rays are traced for the first time, for which the host waits.
        """
        while self._coming and self._coming[0][1].has_arrived():
            kind, number = self._coming.pop(0)
            self._remember(kind, int(number.values()))
        kind = _kind(cameras, grid, feature_size, rays_per_cell)
        if kind not in self._most or not self._is_fused(cameras.intrinsics.device):
            return self(cameras, grid, feature_size, rays_per_cell)
        from raytran.ops.triton.traverse import trace_blocks

        room = max(2 * self._most[kind], _LEAST_ROOM)
        pairs, found = trace_blocks(cameras, grid, feature_size, rays_per_cell, capacity=room)
        self.fits = found <= room
        self._coming.append((kind, HostCopy(found)))
        return _complete(pairs)

    def _remember(self, kind: tuple[int, ...], number: int) -> None:
        self._most[kind] = max(number, self._most.get(kind, 0))

    def _is_fused(self, device: torch.device) -> bool:
        reason = why_no_kernels(device)
        if self.attention == "fused" and reason is not None and not interpreted():
            raise ConfigError(f"attention=fused needs a GPU with Triton, but {reason}: set attention=auto")
        return self.attention == "fused" or (self.attention == "auto" and reason is None)


def _kind(
    cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int
) -> tuple[int, ...]:
    """Return what is alike in all steps of a run."""
    return (*cameras.intrinsics.shape, *grid.resolution, *feature_size, rays_per_cell)


def _complete(pairs: Pairs) -> Pairs:
    """Return the pairs with all made that depends on the data: better here than in compiled code."""
    pairs.orders()
    pairs.pixels_per_voxel()
    return pairs
