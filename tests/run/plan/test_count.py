# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode

from raytran.geometry.grid import VoxelGrid
from raytran.ops.traverse import trace_pairs
from raytran.run.entry import compose
from raytran.run.plan.camera_paths import walk
from raytran.run.plan.count import Work, count_dense, count_part
from raytran.run.plan.dry_run import fake_copy
from raytran.run.plan.forecast import Load
from raytran.run.plan.step_parts import step_parts
from raytran.run.train.build import build_model
from raytran.structs import Views


def test_a_linear_layer_by_hand() -> None:
    """3 rows, 4 → 8 channels: a product forward; one for each side's gradient and none for the bias."""
    with FakeTensorMode():
        layer, x = nn.Linear(4, 8), torch.empty(3, 4, requires_grad=True)
        forward = count_dense(lambda: layer(x), training=False)
        both = count_dense(lambda: layer(x))
    assert forward.operations == 2 * 3 * 4 * 8
    assert forward.bytes == 4 * (3 * 4 + 4 * 8 + 8 + 3 * 8)
    assert both.operations == 3 * forward.operations
    products = (3 * 8 + 8 * 4 + 3 * 4) + (3 * 8 + 3 * 4 + 4 * 8)
    assert both.bytes == forward.bytes + 4 * products


def test_what_lies_between_products_is_free() -> None:
    with FakeTensorMode():
        x = torch.empty(1000, requires_grad=True)
        assert count_dense(lambda: nn.functional.gelu(x).exp()) == Work(0, 0)


def test_work_adds_up_and_takes_the_higher_of_two_times() -> None:
    work = Work(6.0, 2.0) + Work(2.0, 2.0) * 2
    assert work == Work(10.0, 6.0)
    assert work.seconds(10.0, 3.0) == 2.0
    assert work.seconds(2.0, 3.0) == 5.0


@pytest.fixture(scope="module")
def counted() -> dict[str, Work]:
    model = build_model(compose("train", ["preset=tiny", "output_dir=x"]))
    load = Load(2, 6, (96, 128), pairs_per_pixel=30.0, fused=False)
    with FakeTensorMode():
        network = fake_copy(model).train()
        pairs = load.fake_pairs(network)
        parts = step_parts(network, load.fake_views(3), pairs)
        return {part.name: count_part(part, network, pairs, element_bytes=4) for part in parts}


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
    load = Load(2, 6, (96, 128), pairs_per_pixel=30.0, fused=False)
    with FakeTensorMode():
        network = fake_copy(model).eval().requires_grad_(False)
        pairs = load.fake_pairs(network)
        parts = {part.name: part for part in step_parts(network, load.fake_views(3), pairs)}
        volume = count_part(parts["3D convolutions"], network, pairs, element_bytes=4, training=False)
        assert count_part(parts["traversal"], network, pairs, element_bytes=4).bytes == 16 * len(pairs)
    assert not any("→" in name for name in parts)
    voxels, channels = 2 * 24 * 24 * 12, 48
    finest = 2 * 2 * 27 * voxels  # two blocks of two convolutions
    down = (27 + 27 + 1) * (voxels / 8 + voxels / 64)
    up = 27 * (voxels / 8 + voxels / 64)  # a transposed convolution works on what comes in
    assert volume.operations == 2 * channels**2 * (finest + down + up)


def test_parts_leave_out_heads_that_do_not_run() -> None:
    model = build_model(compose("train", ["preset=tiny", "output_dir=x"]))
    with FakeTensorMode():
        network = fake_copy(model).train()
        load = Load(1, 2, (32, 32), pairs_per_pixel=3.0, fused=False)
        parts = step_parts(network, load.fake_views(3), load.fake_pairs(network), tasks=("occupancy",))
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
