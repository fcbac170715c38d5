# SPDX-License-Identifier: Apache-2.0
"""The parts that a training step is made of, each on its own: to be counted, or to be measured.

Their inputs are random features of the right sizes, so that no part waits for the one before. The same code
runs on fake tensors (``part_work.py``) and on real ones (``benchmarks/step.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from raytran.backbone.backbone import Backbone
from raytran.backbone.block import RayTracedBlock, Stream
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid, ray_code
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

    def features(*shape: int) -> Tensor:
        like = backbone.voxel_norm.weight
        return torch.randn(*shape, dtype=like.dtype, device=like.device, requires_grad=model.training)

    voxels = features(scenes, *grid.resolution, backbone.channels)
    pixels = features(scenes * count, height, width, backbone.channels)

    def encode() -> Tensor:
        found = backbone.image_features(views.images)
        return (
            found + backbone.ray_position(ray_code(cameras, grid, (height, width))) if has_blocks else found
        )

    def trace() -> None:
        model.trace(cameras, grid)

    has_blocks = isinstance(backbone, Backbone)
    parts = [
        Part("encoder", 1, encode),
        Part("traversal", 1, trace, "traversal" if has_blocks else "projection"),
        Part("splat", 1, lambda: splat_features(pixels.flatten(0, 2), pairs)[0], "splat"),
    ]
    if has_blocks:
        block, blocks = cast("RayTracedBlock", backbone.blocks[0]), len(backbone.blocks)
        idle = backbone.idle_modules(with_pixels="foreground" in tasks)
        to_pixels = blocks - sum(name.endswith(".pixel_stream") for name in idle)
        parts += _stream_parts("pixels → voxels", blocks, block.voxel_stream, voxels, pixels, pairs)
        parts += _stream_parts("voxels → pixels", to_pixels, block.pixel_stream, pixels, voxels, pairs)
    else:
        parts.append(Part("3D convolutions", 1, lambda: backbone.voxel_network(voxels)))
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
        x.detach()
        .reshape(-1, stream.num_heads, x.shape[-1] // stream.num_heads)
        .requires_grad_(x.requires_grad)
        for x in (target, source, source)
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
    found = model.heads["objects"](voxels, grid)
    outputs = found.layers if found.proposals is None else (*found.layers, found.proposals)
    said = [getattr(output, name).sum() for output in outputs for name in _PREDICTED]
    return torch.stack(said).sum()


_PREDICTED = ("class_logits", "center", "log_size", "yaw_vector")
