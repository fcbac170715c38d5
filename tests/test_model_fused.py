# SPDX-License-Identifier: Apache-2.0
"""The whole network on the fused kernels, on a GPU or in Triton's interpreter, against torch.sparse."""

from __future__ import annotations

import pytest
import torch

from raytran.backbone.backbone import Backbone
from raytran.backbone.resnet import ResNet18
from raytran.heads.auxiliary import ForegroundHead, OccupancyHead
from raytran.model import RayTran
from raytran.ops.traverse import RayTracer
from raytran.ops.triton import block_pairs
from raytran.ops.triton.block_pairs import BlockPairs
from raytran.structs import RawScene, Views

pytest.importorskip("triton", reason="Triton is not installed: the fused kernels have nothing to run on")

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
TASKS = ("occupancy", "foreground")


def _model(attention: str = "sparse") -> RayTran:
    torch.manual_seed(0)
    backbone = Backbone(
        encoder=ResNet18(width=8, input_channels=3), channels=16, num_heads=1, num_blocks=1, expansion=1
    )
    heads = {
        "occupancy": OccupancyHead(channels=16),
        "foreground": ForegroundHead(channels=16, widths=(8, 8, 4)),
    }
    return RayTran(
        backbone=backbone,
        heads=heads,
        grid_resolution=(5, 5, 3),
        grid_extent=(4.0, 4.0, 2.0),
        rays_per_cell=1,
        attention=attention,
    ).to(DEVICE)


def _views() -> Views:
    pose = torch.eye(4).repeat(1, 2, 1, 1)
    pose[..., :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[..., :3, 3] = torch.tensor([[0.1, 0.2, 0.0], [-0.3, -0.4, 0.1]])
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(1, 2, 3, 3)
    images = torch.rand(1, 2, 3, 32, 48, generator=torch.Generator().manual_seed(1))
    return Views(images, intrinsics, pose).to(DEVICE)


@pytest.fixture(autouse=True)
def few_slots(monkeypatch):
    """The interpreter takes its time over every program, also of a slot that is not used."""
    monkeypatch.setattr(block_pairs, "_SLOTS", 16)


def _loss(raw: RawScene) -> torch.Tensor:
    return raw.occupancy.square().mean() + raw.foreground.square().mean()


def test_equals_the_network_on_torch_sparse(monkeypatch):
    model, views = _model(), _views()
    expected = model(views, tasks=TASKS)
    gradients = torch.autograd.grad(_loss(expected), list(model.parameters()), allow_unused=True)
    traced = []
    tracer = RayTracer("fused")

    def trace(*arguments):
        traced.append(tracer(*arguments))
        return traced[-1]

    monkeypatch.setattr(model, "ray_tracer", trace)
    actual = model(views, tasks=TASKS)
    assert isinstance(traced[0], BlockPairs)
    torch.testing.assert_close(actual.occupancy, expected.occupancy, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(actual.foreground, expected.foreground, atol=1e-5, rtol=1e-4)
    for mine, theirs in zip(
        torch.autograd.grad(_loss(actual), list(model.parameters()), allow_unused=True),
        gradients,
        strict=True,
    ):
        assert (mine is None) == (theirs is None)
        if mine is not None:
            torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-3)


def test_prediction_in_chunks_of_views():
    model, views = _model("fused").eval(), _views()
    with torch.no_grad():
        whole, chunked = model(views, tasks=TASKS), model(views, tasks=TASKS, views_at_once=1)
    torch.testing.assert_close(chunked.occupancy, whole.occupancy, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(chunked.foreground, whole.foreground, atol=1e-5, rtol=1e-4)
