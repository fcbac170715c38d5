# SPDX-License-Identifier: Apache-2.0
"""Part 2, the operators: the fused kernels against the dense twin in float64, and against themselves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from camera_path import paper_grid
from torch import Tensor

from gpu_day.context import Context
from raytran.geometry.camera import Cameras
from raytran.ops import reference
from raytran.ops.pairs import listed
from raytran.ops.ray_attention import Direction, ray_attention
from raytran.ops.splat import splat_features
from raytran.ops.traverse import RayTracer, trace_pairs
from raytran.ops.triton import block_pairs
from raytran.ops.triton.block_pairs import BlockPairs
from raytran.run.plan.camera_paths import walk

DIRECTIONS: tuple[Direction, ...] = ("pixels_to_voxels", "voxels_to_pixels")

TOLERANCE = {torch.float32: 3e-6, torch.float16: 1.3e-3, torch.bfloat16: 1e-2}
"""Norm of the error over the norm of what is right, of the result and each gradient. In 16 bits three times
what rounding alone makes where the kernels round (weights, gradients of scores, results): 4e-4 and 3.2e-3 at
most, computed in float64 for 3 to 300 sources a target. (Triton's interpreter cuts off instead of rounding to
bfloat16 and has 8e-3.) In 32 bits ten times what Triton's interpreter has; TF32 would make 5e-4."""

SPLAT_TOLERANCE = {torch.float32: 1e-6, torch.float16: 5e-4, torch.bfloat16: 4e-3}
"""The mean is rounded once: half a unit in the last place of each dtype, and in 32 bits of the sums."""

DIFFERENCE_TOLERANCE = 1e-3
"""Of a derivative along a random direction, over its usual size; the differences err by 1e-4."""


def operators(context: Context) -> None:
    """Check traversal, attention and splatting on the device."""
    check_operators(context, context.device.torch_device, "")


def operators_elsewhere(context: Context) -> None:
    """Check them again on the second GPU while the first is the current one."""
    name = "kernels on cuda:1 while cuda:0 is current"
    if torch.cuda.device_count() < 2:
        context.checks.add(
            name, bar="as on cuda:0", why="there is one GPU" if torch.cuda.device_count() else "no GPU"
        )
        return
    torch.cuda.set_device(0)
    check_operators(context, torch.device("cuda:1"), " (cuda:1)")


def check_operators(context: Context, where: torch.device, suffix: str) -> None:
    """Check all operators on one device."""
    tracer = RayTracer(context.device.attention)
    _check_traversal(context, tracer, where, suffix)
    pairs: BlockPairs | None = None
    with context.checks.attempt(f"pairs to compare on{suffix}"):
        pairs = _dense_pairs(context, tracer, where)
    if pairs is None:
        return
    for dtype in context.sizes.dtypes:
        for direction in DIRECTIONS:
            _check_attention(context, pairs, direction, dtype, 32, suffix)
    for width in context.sizes.widths:
        _check_attention(context, pairs, "pixels_to_voxels", torch.bfloat16, width, suffix)
    for direction in DIRECTIONS:
        _check_differences(context, pairs, direction, suffix)
        with _short_pieces():
            cut = BlockPairs(pairs.key, pairs.masks, pairs.pixels, pairs.voxels)
            is_cut = all((cut.by(side).merges[:, 0] >= 0).any() for side in ("pixels", "voxels"))
        told = "rows cut into pieces" if is_cut else "no row long enough to be cut"
        _check_attention(context, cut, direction, torch.bfloat16, 32, f", {told}{suffix}")
    for dtype in context.sizes.dtypes:
        _check_splat(context, pairs, dtype, suffix)


def _check_traversal(context: Context, tracer: RayTracer, where: torch.device, suffix: str) -> None:
    name, bar = f"traversal{suffix}", "the pairs that the CPU finds"
    with context.checks.attempt(name, bar):
        sizes = context.sizes
        cameras = walk(sizes.views)
        grid = paper_grid(cameras, sizes.grid)
        expected = trace_pairs(cameras, grid, sizes.feature_size, 2)
        cameras = Cameras(
            cameras.intrinsics.to(where), cameras.world_from_camera.to(where), cameras.image_size
        )
        traced = tracer(cameras, paper_grid(cameras, sizes.grid), sizes.feature_size, 2)
        fused = isinstance(traced, BlockPairs)
        actual = listed(traced)
        keys = [(p.pixel_index * p.num_voxels + p.voxel_index).cpu() for p in (actual, expected)]
        wrong = len(set(keys[0].tolist()) ^ set(keys[1].tolist()))
        measured = f"{wrong} of {len(expected):,} pairs differ" + ("" if fused else "; not by the kernels")
        context.checks.add(name, bar=bar, measured=measured, passed=wrong == 0 and fused)


def _dense_pairs(context: Context, tracer: RayTracer, where: torch.device) -> BlockPairs:
    """Return pairs of so few pixels and voxels that all scores between them fit into memory.

    Raises:
        TypeError: the kernels do not run here.
    """
    views, *size = context.sizes.dense_pixels
    cameras = walk(views)
    cameras = Cameras(cameras.intrinsics.to(where), cameras.world_from_camera.to(where), cameras.image_size)
    pairs = tracer(cameras, paper_grid(cameras, context.sizes.dense_grid), (size[0], size[1]), 2)
    if not isinstance(pairs, BlockPairs):
        raise TypeError("pairs are not traced by the kernels here")
    return pairs


def _check_attention(
    context: Context, pairs: BlockPairs, direction: Direction, dtype: torch.dtype, width: int, suffix: str
) -> None:
    kind = str(dtype).removeprefix("torch.")
    name = f"attention, {direction.replace('_', ' ')}, {kind}, heads of {width}{suffix}"
    bar = f"error of result and gradients ≤ {TOLERANCE[dtype]:.1e}, the same bits twice"
    with context.checks.attempt(name, bar):
        inputs, weight = _inputs(pairs, direction, dtype, context.sizes.heads, width)
        actual, again = (
            _value_and_gradients(ray_attention, inputs, pairs, direction, weight) for _ in range(2)
        )
        exact = [tensor.double() for tensor in inputs]
        expected = _value_and_gradients(
            reference.ray_attention, exact, listed(pairs), direction, weight.double()
        )
        errors = [_error(mine, theirs) for mine, theirs in zip(actual, expected, strict=True)]
        same = all(bool((one == other).all()) for one, other in zip(actual, again, strict=True))
        parts = zip(("result", "dq", "dk", "dv"), errors, strict=True)
        told = ", ".join(f"{part} {error:.1e}" for part, error in parts) + ("" if same else ", OTHER BITS")
        context.checks.add(name, bar=bar, measured=told, passed=same and max(errors) <= TOLERANCE[dtype])


def _check_splat(context: Context, pairs: BlockPairs, dtype: torch.dtype, suffix: str) -> None:
    name = f"splat, {str(dtype).removeprefix('torch.')}{suffix}"
    bar = f"error of result and gradient ≤ {SPLAT_TOLERANCE[dtype]:.1e}"
    with context.checks.attempt(name, bar):
        numbers, channels = torch.Generator().manual_seed(0), 32 * context.sizes.heads
        shapes = (pairs.num_pixels, channels), (pairs.num_voxels, channels)
        features, weight = (torch.randn(s, generator=numbers).to(pairs.key.device, dtype) for s in shapes)
        found = []
        for splat, some, precise in (
            (splat_features, pairs, dtype),
            (reference.splat_features, listed(pairs), torch.float64),
        ):
            taken = features.to(precise).detach().requires_grad_()
            mean, seen = splat(taken, some)
            found.append([mean, *torch.autograd.grad(mean, taken, weight.to(precise)), seen])
        errors = [_error(mine, theirs) for mine, theirs in zip(found[0][:2], found[1][:2], strict=True)]
        same = bool((found[0][2] == found[1][2]).all())
        measured = f"result {errors[0]:.1e}, gradient {errors[1]:.1e}" + (
            "" if same else ", other voxels are seen"
        )
        context.checks.add(
            name, bar=bar, measured=measured, passed=max(errors) <= SPLAT_TOLERANCE[dtype] and same
        )


def _check_differences(context: Context, pairs: BlockPairs, direction: Direction, suffix: str) -> None:
    name = f"gradients by finite differences, {direction.replace('_', ' ')}, float32{suffix}"
    bar = f"error ≤ {DIFFERENCE_TOLERANCE:.0e}"
    with context.checks.attempt(name, bar):
        inputs, weight = _inputs(pairs, direction, torch.float32, context.sizes.heads, 32)
        _, *gradients = _value_and_gradients(ray_attention, inputs, pairs, direction, weight)
        numbers, worst, step = torch.Generator().manual_seed(1), 0.0, 1e-2
        for place, gradient in enumerate(gradients):
            for _ in range(context.sizes.probes):
                along = torch.randn(gradient.shape, generator=numbers).to(gradient.device)
                values = []
                for sign in (1, -1):
                    moved = [x + sign * step * along if i == place else x for i, x in enumerate(inputs)]
                    values.append((ray_attention(*moved, pairs, direction).double() * weight.double()).sum())
                difference = (values[0] - values[1]) / (2 * step)
                # Along a random direction a derivative is about as large as the gradient.
                error = (
                    difference - (gradient.double() * along.double()).sum()
                ).abs() / gradient.double().norm()
                worst = max(worst, float(error))
        context.checks.add(name, bar=bar, measured=f"{worst:.1e}", passed=worst <= DIFFERENCE_TOLERANCE)


def _inputs(
    pairs: BlockPairs, direction: Direction, dtype: torch.dtype, heads: int, width: int
) -> tuple[list[Tensor], Tensor]:
    """Return query, key and value at random, and a gradient of the result."""
    numbers, sizes = torch.Generator().manual_seed(0), (pairs.num_voxels, pairs.num_pixels)
    targets, sources = sizes if direction == "pixels_to_voxels" else sizes[::-1]
    made = [
        torch.randn(n, heads, width, generator=numbers).to(pairs.key.device, dtype)
        for n in (targets, sources, sources, targets)
    ]
    return made[:3], made[3]


def _value_and_gradients(
    attention: Callable[..., Tensor],
    inputs: list[Tensor],
    pairs: object,
    direction: Direction,
    weight: Tensor,
) -> list[Tensor]:
    taken = [tensor.detach().requires_grad_() for tensor in inputs]
    out = attention(*taken, pairs, direction)
    return [out.detach(), *torch.autograd.grad(out, taken, weight)]


def _error(mine: Tensor, theirs: Tensor) -> float:
    """Return the norm of the error over that of what is right; infinite if something is not finite."""
    error = float((mine.detach().double() - theirs.detach()).norm() / theirs.detach().norm())
    return error if math.isfinite(error) else math.inf


@contextmanager
def _short_pieces() -> Iterator[None]:
    """Let rows be cut as they are with many views."""
    before = block_pairs._PIECES
    block_pairs._PIECES = [2 << power for power in range(10)] + [1 << 30]
    try:
        yield
    finally:
        block_pairs._PIECES = before
