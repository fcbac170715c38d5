# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch
from part_work import work_of_parts
from step_parts import step_parts
from torch import Tensor

from raytran.geometry.grid import VoxelGrid
from raytran.ops.traverse import trace_pairs
from raytran.run.entry import compose
from raytran.run.plan.camera_paths import walk
from raytran.run.plan.dry_run import FakePairs, Load, dry_network
from raytran.run.plan.roofline import Work
from raytran.run.train.build import build_model
from raytran.structs import Views

LOAD = Load(2, 6, (96, 128), pairs_per_pixel=30.0, fused=False)


@pytest.fixture(scope="module")
def counted() -> dict[str, Work]:
    model = build_model(compose("train", ["preset=tiny", "output_dir=x"]))
    # Of one block, so that every part runs once.
    model.backbone.blocks = model.backbone.blocks[:1]
    return work_of_parts(model, LOAD)


def test_the_feed_forward_of_the_tiny_network_by_hand(counted: dict[str, Work]) -> None:
    voxels, channels, hidden = 2 * 24 * 24 * 12, 48, 96
    products = voxels * channels * hidden * (27 + 1)
    assert counted["feed-forward, pixels → voxels"].operations == 3 * 2 * products


def test_attention_counts_pairs_and_rows(counted: dict[str, Work]) -> None:
    pixels, voxels, channels = 2 * 6 * 6 * 8, 2 * 24 * 24 * 12, 48
    for name in ("attention, pixels → voxels", "attention, voxels → pixels"):
        assert counted[name].operations == 14 * 30 * pixels * channels
        assert counted[name].bytes == 6 * 4 * (pixels + voxels) * channels


def test_every_part_costs_something(counted: dict[str, Work]) -> None:
    assert {"encoder", "traversal", "splat", "occupancy head", "foreground head", "objects head"} < set(
        counted
    )
    assert all(work.operations > 0 and work.bytes > 0 for work in counted.values())


def test_the_convolutions_of_the_baseline_by_hand() -> None:
    model = build_model(compose("train", ["preset=tiny", "model/backbone=unprojection", "output_dir=x"]))
    work = work_of_parts(model, LOAD)
    assert not any("→" in name for name in work)
    assert work["traversal"].bytes == 16 * 30 * 2 * 6 * 6 * 8
    voxels, channels = 2 * 24 * 24 * 12, 48
    finest = 2 * 2 * 27 * voxels  # two blocks of two convolutions
    down = (27 + 27 + 1) * (voxels / 8 + voxels / 64)
    up = 27 * (voxels / 8 + voxels / 64)  # a transposed convolution works on what comes in
    assert work["3D convolutions"].operations == 3 * 2 * channels**2 * (finest + down + up)


def test_parts_leave_out_heads_that_do_not_run() -> None:
    model = build_model(compose("train", ["preset=tiny", "output_dir=x"]))
    with dry_network(model, LOAD, "32-true") as (network, _):
        network.train()
        pairs = FakePairs.of(LOAD.scenes * LOAD.views * 6 * 8, 2 * 24 * 24 * 12, 3.0)
        parts = step_parts(network, LOAD.fake_views(3), pairs, tasks=("occupancy",))
    times = {part.name: part.times for part in parts}
    assert "objects head" not in times
    assert "foreground head" not in times
    assert times["attention, pixels → voxels"] == 2
    assert times["attention, voxels → pixels"] == 1  # nothing reads the pixels of the last block


def test_parts_run_on_real_tensors_too() -> None:
    """What is counted is what is measured: every part gives a result, all with gradients."""
    model = build_model(compose("train", ["preset=tiny", "output_dir=x"])).train()
    cameras = walk(2).scaled_to((32, 48))
    grid = VoxelGrid(model.grid_resolution, model.grid_extent, cameras.position.mean(dim=0))
    pairs = trace_pairs(cameras, grid, (2, 3))
    lead = (cameras.intrinsics[None].float(), cameras.world_from_camera[None].float())
    views = Views(torch.zeros(1, 2, 3, 32, 48, dtype=torch.uint8), *lead)
    for part in step_parts(model, views, pairs):
        out = part.run()
        if isinstance(out, Tensor):
            out.sum().backward()
        else:
            assert part.over_pairs == "traversal"
    unused = [name for name, x in model.named_parameters() if x.grad is None]
    # Of the blocks the first stands for all; a part's normalisation is that of the stream.
    assert all(
        name.startswith(
            ("backbone.blocks", "backbone.unseen", "backbone.voxel", "backbone.pixel", "heads.shape")
        )
        for name in unused
    )
