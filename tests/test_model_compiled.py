# SPDX-License-Identifier: Apache-2.0
"""The network is one graph for ``torch.compile``, with rays traced before: on torch.sparse and on kernels."""

from __future__ import annotations

import pytest
import torch

from raytran.geometry.camera import Cameras
from raytran.losses.matcher import HungarianMatcher
from raytran.losses.total import TotalLoss
from raytran.ops.traverse import RayTracer
from raytran.ops.triton import block_pairs
from raytran.structs import SceneBatch

from .factories import RESOLUTION, WEIGHTS, make_model, make_objects, make_views

TASKS = ("occupancy", "foreground", "objects", "view")


@pytest.fixture
def batch() -> SceneBatch:
    views, generator = make_views(), torch.Generator().manual_seed(1)
    return SceneBatch(
        ("a",),
        views,
        (("0", "1"),),
        Cameras.of(views).position.mean(dim=1),
        objects=(make_objects(3),),
        occupancy=torch.rand(1, *RESOLUTION, generator=generator) > 0.5,
        foreground=torch.rand(1, 2, 32, 48, generator=generator) > 0.5,
        new_views=views,
    )


@pytest.mark.parametrize("attention", ["sparse", "fused"])
def test_is_one_graph_with_the_same_losses_and_gradients(attention, batch, monkeypatch) -> None:
    if attention == "fused":
        pytest.importorskip("triton", reason="Triton is not installed: the fused kernels do not run")
        monkeypatch.setattr(block_pairs, "_SLOTS", 16)  # the interpreter takes its time over unused ones
    model = make_model()
    model.rays_per_cell, model.ray_tracer = 1, RayTracer(attention)
    model.backbone.blocks = model.backbone.blocks[:1]  # dynamo takes its time over each
    loss = TotalLoss(weights=WEIGHTS, matcher=HungarianMatcher(weights=WEIGHTS))
    cameras = Cameras.of(batch.new_views)
    traced = model.trace_views(batch.views, grid_center=batch.grid_center, new_cameras=cameras)
    trained = [p for name, p in model.named_parameters() if not name.startswith("heads.shape")]
    found = []
    for run in (model, torch.compile(model.forward, fullgraph=True, backend="aot_eager")):
        raw = run(batch.views, tasks=TASKS, new_cameras=cameras, traced=traced)
        losses = loss(raw, batch, terms=TASKS)
        found.append((losses, torch.autograd.grad(losses["total"], trained)))
    (plain, gradients), (compiled, others) = found
    torch.testing.assert_close(compiled, plain, atol=1e-5, rtol=1e-5)
    for mine, theirs in zip(others, gradients, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-3)


def test_what_is_traced_before_is_what_is_traced_within(batch) -> None:
    model = make_model().eval()
    for views_at_once in (None, 1):
        with torch.no_grad():
            along = model.trace_views(batch.views, views_at_once=views_at_once)
            given = model(batch.views, views_at_once=views_at_once, traced=along)
            alone = model(batch.views, views_at_once=views_at_once)
        assert torch.equal(given.grid_center, batch.grid_center)
        assert torch.equal(given.occupancy, alone.occupancy)
