# SPDX-License-Identifier: Apache-2.0
"""Small networks, views and objects that many tests share."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from raytran.backbone.backbone import Backbone, VoxelBackbone
from raytran.backbone.block import Stream
from raytran.backbone.resnet import ResNet18
from raytran.extensions.denoising import DenoisingObjectHead
from raytran.extensions.proposal_queries import ProposalQueries
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.heads.auxiliary import ForegroundHead, OccupancyHead
from raytran.heads.objects import ObjectHead
from raytran.heads.shape import ShapeHead
from raytran.heads.view import ViewHead
from raytran.model import RayTran
from raytran.ops.pairs import Pairs
from raytran.structs import ObjectSet, Views

RESOLUTION, EXTENT, CHANNELS = (6, 6, 4), (6.0, 6.0, 3.0), 16
WEIGHTS = dict.fromkeys(
    ("occupancy", "foreground", "class", "center", "size", "yaw", "heat", "shape", "view"), 1.0
)


def make_model(
    input_channels: int = 3,
    stride: int = 16,
    widths: tuple[int, ...] = (8, 8, 4),
    queries: Literal["learned", "proposal"] = "learned",
    num_copies: int = 0,
) -> RayTran:
    torch.manual_seed(0)
    settings: dict[str, Any] = {
        "channels": CHANNELS,
        "num_heads": 2,
        "num_layers": 2,
        "num_queries": 5,
        "hidden": 16,
        "grid_extent": EXTENT,
        "queries": ProposalQueries if queries == "proposal" else None,
    }
    heads = {
        "occupancy": OccupancyHead(channels=CHANNELS),
        "foreground": ForegroundHead(channels=CHANNELS, widths=widths),
        "objects": DenoisingObjectHead(num_copies=num_copies, **settings)
        if num_copies
        else ObjectHead(**settings),
        "shape": ShapeHead(channels=CHANNELS, widths=(8, 8, 4, 4)),
        "view": ViewHead(
            stream=Stream(channels=CHANNELS, num_heads=2, expansion=1, direction="voxels_to_pixels"),
            channels=CHANNELS,
            widths=widths,
        ),
    }
    encoder = ResNet18(width=8, stride=stride, input_channels=input_channels)
    backbone = Backbone(encoder=encoder, channels=CHANNELS, num_heads=2, num_blocks=2, expansion=1)
    return RayTran(backbone=backbone, heads=heads, grid_resolution=RESOLUTION, grid_extent=EXTENT)


def make_views(scenes: int = 1, views: int = 2, channels: int = 3) -> Views:
    """Cameras at about (0, ±1, 0) that look along +y."""
    g = torch.Generator().manual_seed(1)
    pose = torch.eye(4).repeat(scenes, views, 1, 1)
    pose[..., :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[..., :3, 3] = torch.rand(scenes, views, 3, generator=g)
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(scenes, views, 3, 3)
    images = torch.randint(0, 256, (scenes, views, channels, 32, 48), generator=g).to(torch.uint8)
    return Views(images, intrinsics, pose)


def make_objects(count: int) -> ObjectSet:
    return ObjectSet(
        label=torch.arange(count),
        center=torch.rand(count, 3),
        size=torch.rand(count, 3) + 0.2,
        rotation=torch.eye(3).expand(count, 3, 3),
        symmetry=torch.ones(count, dtype=torch.long),
        score=torch.ones(count),
        shape=torch.rand(count, 63, 63, 63) > 0.5,
    )


def digests(root: Path) -> dict[str, str]:
    """Return what stands for the content of every file below a folder, by its name there."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


class Trained(NamedTuple):
    """A checkpoint as training writes it, and the network in it."""

    path: Path
    model: RayTran


def run_backbone(
    backbone: VoxelBackbone,
    images: Tensor,
    cameras: Cameras,
    grid: VoxelGrid,
    trace: Callable[[Cameras], Pairs],
    *,
    views_at_once: int | None = None,
    with_pixels: bool = True,
) -> tuple[Tensor, Tensor | None]:
    """Run a backbone on all views at once, or in chunks; pixel features come back in one tensor."""
    count = images.shape[1]
    step = views_at_once or count
    chunks = [slice(start, start + step) for start in range(0, count, step)]
    cameras_of = [cameras.select(chunk) for chunk in chunks]
    voxels, pixels = backbone(
        [images[:, chunk] for chunk in chunks],
        cameras_of,
        grid,
        [trace(some) for some in cameras_of],
        with_pixels=with_pixels,
    )
    return voxels, None if pixels is None else torch.cat(pixels, dim=1)
