# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import pytest
import torch

from raytran.backbone.backbone import Backbone
from raytran.backbone.resnet import ResNet18
from raytran.errors import ConfigError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList
from raytran.ops.traverse import trace_pairs

from ..factories import make_model, make_views, run_backbone


def make_backbone(num_blocks: int = 2) -> Backbone:
    torch.manual_seed(0)
    backbone = Backbone(encoder=ResNet18(width=8), channels=16, num_heads=2, num_blocks=num_blocks).eval()
    # Scores far from equal, so that a wrong weight between chunks shows.
    for block in backbone.blocks:
        torch.nn.init.normal_(block.voxel_stream.query.weight)
        torch.nn.init.normal_(block.voxel_stream.key.weight)
    return backbone


def scene(scenes: int, views: int, generator: torch.Generator) -> dict[str, Any]:
    """Cameras that look along +y through a grid of which they see a part."""
    pose = torch.eye(4).repeat(scenes, views, 1, 1)
    pose[..., :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[..., :3, 3] = torch.rand(scenes, views, 3, generator=generator) - torch.tensor([0.5, 1.5, 0.5])
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(scenes, views, 3, 3)
    return {
        "images": torch.rand(scenes, views, 3, 32, 48, generator=generator),
        "cameras": Cameras(intrinsics, pose, (32, 48)),
        "grid": VoxelGrid((5, 6, 4), (5.0, 6.0, 3.0), torch.zeros(scenes, 3)),
    }


@pytest.mark.parametrize("bidirectional", [True, False])
@pytest.mark.parametrize(("scenes", "views", "views_at_once"), [(1, 5, 2), (2, 3, 1), (1, 2, 2), (1, 1, 7)])
def test_chunks_give_what_all_views_give(
    scenes: int, views: int, views_at_once: int, bidirectional: bool, generator: torch.Generator
) -> None:
    backbone, inputs = make_backbone(), scene(scenes, views, generator)
    backbone.bidirectional = bidirectional

    def trace(cameras: Cameras) -> PairList:
        return trace_pairs(cameras, inputs["grid"], (2, 3))

    pairs = trace(inputs["cameras"])
    assert 0 < pairs.voxel_index.unique().numel() < pairs.num_voxels  # some voxels are seen, some are not
    voxels, pixels = run_backbone(backbone, **inputs, trace=trace)
    chunked = run_backbone(backbone, **inputs, trace=trace, views_at_once=views_at_once)
    torch.testing.assert_close(chunked[0], voxels, rtol=5e-6, atol=5e-6)
    torch.testing.assert_close(chunked[1], pixels, rtol=5e-6, atol=5e-6)
    alone = run_backbone(backbone, **inputs, trace=trace, views_at_once=views_at_once, with_pixels=False)
    torch.testing.assert_close(alone[0], voxels, rtol=5e-6, atol=5e-6)
    assert alone[1] is None


def test_no_more_views_pass_together_than_were_asked_for(generator: torch.Generator) -> None:
    backbone, inputs, seen = make_backbone(), scene(1, 5, generator), []
    backbone.encoder.register_forward_pre_hook(lambda _, args: seen.append(len(args[0])))

    def trace(cameras: Cameras) -> PairList:
        seen.append(cameras.intrinsics.shape[1])
        return trace_pairs(cameras, inputs["grid"], (2, 3))

    run_backbone(backbone, **inputs, trace=trace, views_at_once=2)
    assert max(seen) == 2


def test_refused_in_training_and_without_a_view(generator: torch.Generator) -> None:
    backbone, inputs = make_backbone().train(), scene(1, 2, generator)

    def trace(cameras: Cameras) -> PairList:
        return trace_pairs(cameras, inputs["grid"], (2, 3))

    with pytest.raises(ConfigError, match="evaluation mode"):
        run_backbone(backbone, **inputs, trace=trace, views_at_once=1)
    with pytest.raises(ConfigError, match="above 0"):
        make_model().eval()(make_views(), views_at_once=0)
