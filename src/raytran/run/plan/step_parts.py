# SPDX-License-Identifier: Apache-2.0
"""The parts that a training step is made of, each on its own: to be counted, or to be measured.

Their inputs are random features of the right sizes, so that no part waits for the one before. The same code
runs on fake tensors (``run.count``) and on real ones (``benchmarks/step.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from raytran.backbone.block import RayTracedBlock, Stream
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.model import TASKS, RayTran
from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import ray_attention
from raytran.ops.splat import splat_features
from raytran.ops.triton.block_pairs import BlockPairs
from raytran.structs import Views


@dataclass(frozen=True)
class Part:
    """One part of a step.

    Attributes:
        name: what it is.
        times: how often a step runs it.
        run: its forward pass; None if there is nothing to take gradients of.
        over_pairs: ``attention`` or ``splat`` for what runs along the pairs, ``traversal`` (of rays) or
            ``projection`` (of voxel centres) for what makes them; None for dense work.
    """

    name: str
    times: int
    run: Callable[[], Tensor | None]
    over_pairs: str | None = None


def step_parts(
    model: RayTran, views: Views, pairs: PairList | BlockPairs, *, tasks: Collection[str] = TASKS
) -> list[Part]:
    """Return the parts of a training step up to the heads, in the order in which they run.

    Losses and optimiser are left out: they need targets and gradients.

    Args:
        model: the network.
        views: posed images of B scenes, on the model's device.
        pairs: their pixel-voxel pairs.
        tasks: heads that run.
    """
    backbone = model.backbone
    cameras = Cameras.of(views)
    grid = VoxelGrid(model.grid_resolution, model.grid_extent, cameras.position.mean(dim=1))
    scenes, count = views.images.shape[:2]
    height, width = (side // backbone.stride for side in views.image_size)
    with_pixels = "foreground" in tasks

    def features(*shape: int) -> Tensor:
        like = backbone.projection.weight
        return torch.randn(*shape, dtype=like.dtype, device=like.device, requires_grad=model.training)

    voxels = features(scenes, *grid.resolution, backbone.channels)
    pixels = features(scenes * count, height, width, backbone.channels)

    def trace() -> None:
        tracer = backbone.tracer or model.ray_tracer
        tracer(cameras, grid, (height, width), model.rays_per_cell)

    parts = [
        Part("encoder", 1, lambda: backbone.embed(views.images, cameras, grid)),
        Part("traversal", 1, trace, "projection" if backbone.tracer else "traversal"),
        Part("splat", 1, lambda: splat_features(pixels.flatten(0, 2), pairs)[0], "splat"),
    ]
    if backbone.blocks:
        block, blocks = cast("RayTracedBlock", backbone.blocks[0]), len(backbone.blocks)
        to_pixels = sum(backbone.updates_pixels(i, with_pixels=with_pixels) for i in range(blocks))
        parts += _stream_parts("pixels → voxels", blocks, block.voxel_stream, voxels, pixels, pairs)
        parts += _stream_parts("voxels → pixels", to_pixels, block.pixel_stream, pixels, voxels, pairs)
    else:
        start, seen = features(scenes * grid.num_voxels, backbone.channels), torch.ones(0)
        parts.append(Part("3D convolutions", 1, lambda: backbone.start_voxels(start, seen, grid)))
    heads = {
        "occupancy": lambda: model.heads["occupancy"](voxels),
        "foreground": lambda: model.heads["foreground"](pixels.unflatten(0, (scenes, count))),
        "objects": lambda: _all_layers(model, voxels, grid),
    }
    return parts + [Part(f"{name} head", 1, run) for name, run in heads.items() if name in tasks]


def _stream_parts(
    name: str,
    times: int,
    stream: Stream,
    target: Tensor,
    source: Tensor,
    pairs: PairList | BlockPairs,
) -> list[Part]:
    """Return the parts of one direction of a block."""
    query, key, value = (
        stream.heads(x).detach().requires_grad_(x.requires_grad) for x in (target, source, source)
    )

    def project() -> Tensor:
        queries = stream.query(stream.norm(target))
        keys, values = stream.keys_and_values(stream.norm(source))
        return stream.output(queries).sum() + keys.sum() + values.sum()

    def attend() -> Tensor:
        return ray_attention(query, key, value, pairs, stream.direction)

    return [
        Part(f"projections, {name}", times, project),
        Part(f"attention, {name}", times, attend, "attention"),
        Part(f"feed-forward, {name}", times, lambda: stream.feed_forward(stream.norm(target))),
    ]


def _all_layers(model: RayTran, voxels: Tensor, grid: VoxelGrid) -> Tensor:
    """Run the object head; return the sum of all that it says, so that all of it gets gradients."""
    layers, proposals = model.heads["objects"](voxels, grid)
    outputs = layers if proposals is None else (*layers, proposals)
    said = [getattr(output, name).sum() for output in outputs for name in _PREDICTED]
    return torch.stack(said).sum()


_PREDICTED = ("class_logits", "center", "log_size", "yaw_vector")
