# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch
from torch import nn

from raytran.backbone.backbone import Backbone
from raytran.backbone.resnet import ResNet18
from raytran.errors import ShapeError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.traverse import trace_pairs
from raytran.viewer.attention_record import observe_attention

from ..factories import run_backbone


@pytest.fixture
def run(generator):
    """Run a small backbone on three views, all at once or two at a time."""
    torch.manual_seed(0)
    backbone = Backbone(encoder=ResNet18(width=8), channels=8, num_heads=2, num_blocks=2).eval()
    pose = torch.eye(4).repeat(1, 3, 1, 1)
    pose[..., :3, 3] = torch.rand(1, 3, 3, generator=generator)
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(1, 3, 3, 3)
    cameras, images = Cameras(intrinsics, pose, (32, 48)), torch.rand(1, 3, 3, 32, 48, generator=generator)
    grid = VoxelGrid((4, 4, 3), (4.0, 4.0, 3.0), torch.zeros(1, 3))

    def go(views_at_once=None):
        def trace(some):
            return trace_pairs(some, grid, (2, 3))

        return run_backbone(backbone, images, cameras, grid, trace, views_at_once=views_at_once)

    return backbone, go


def test_what_voxels_ask_and_pixels_answer_is_kept(run):
    backbone, go = run
    expected = go()
    with observe_attention(backbone) as record:
        seen = go()
    torch.testing.assert_close(seen, expected, rtol=0, atol=0)
    ((query, key),) = record.runs([18])
    assert (query.shape, key.shape) == ((48, 2, 4), (18, 2, 4))
    with observe_attention(backbone) as chunked:
        go(views_at_once=2)
    assert len(chunked.keys) == 2
    torch.testing.assert_close(chunked.runs([18]), [(query, key)], rtol=1e-4, atol=1e-5)


def test_it_is_the_last_block_that_is_observed(run):
    backbone, go = run
    inputs = []
    handle = backbone.blocks[1].voxel_norm.register_forward_hook(lambda *given: inputs.append(given[2]))
    with observe_attention(backbone) as record:
        go()
    handle.remove()
    expected = backbone.blocks[1].voxel_stream.query(inputs[0]).view(48, 2, 4)
    torch.testing.assert_close(record.runs([18])[0][0], expected.detach())


def test_nobody_listens_afterwards(run):
    backbone, go = run
    with pytest.raises(ZeroDivisionError), observe_attention(backbone) as record:
        raise ZeroDivisionError
    go()
    assert record.queries == record.keys == []
    assert not any(module._forward_hooks for module in backbone.modules())


def test_several_runs_are_told_apart(run):
    backbone, go = run
    with observe_attention(backbone) as record:
        go()
        go(views_at_once=2)
    first, second = record.runs([18, 18])
    torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-5)
    with pytest.raises(ShapeError, match="expected 1 runs on 18 pixels, observed 2 on 36"):
        record.runs([18])


def test_a_network_without_rays_has_no_record():
    with observe_attention(nn.Linear(2, 2)) as record:
        pass
    assert record is None
