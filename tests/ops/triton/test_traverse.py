# SPDX-License-Identifier: Apache-2.0
"""Traversal by kernels, on a GPU if there is one, else in Triton's interpreter (``tests/conftest.py``)."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from raytran.errors import ConfigError, ShapeError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops import traverse
from raytran.ops.pairs import PairList
from raytran.ops.traverse import RayTracer, trace_pairs
from raytran.ops.triton.block_pairs import BlockPairs

pytest.importorskip("triton", reason="Triton is not installed: the kernels have nothing to run on")

from raytran.ops.triton.traverse import trace_blocks

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def _on_device(cameras: Cameras, grid: VoxelGrid) -> tuple[Cameras, VoxelGrid]:
    return cameras.to(DEVICE), VoxelGrid(grid.resolution, grid.extent, grid.center.to(DEVICE))


def _check(cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int) -> None:
    expected = trace_pairs(cameras, grid, feature_size, rays_per_cell)
    blocks, number = trace_blocks(*_on_device(cameras, grid), feature_size, rays_per_cell)
    actual = PairList.from_blocks(blocks.to("cpu"))
    assert (actual.num_pixels, actual.num_voxels) == (expected.num_pixels, expected.num_voxels)
    assert torch.equal(actual.pixel_index, expected.pixel_index)
    assert torch.equal(actual.voxel_index, expected.voxel_index)
    assert int(number) == len(blocks) >= len(expected.blocks())
    assert (blocks.key.diff() > 0).all()


@pytest.mark.parametrize("spread", [0.3, 1.5, 6.0], ids=["inside", "around", "outside"])
@pytest.mark.parametrize(("feature_size", "rays_per_cell"), [((5, 9), 2), ((3, 4), 1)])
def test_equals_the_pair_list(random_cameras, spread, feature_size, rays_per_cell):
    grid = VoxelGrid((9, 5, 6), (4.1, 2.3, 2.7), torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64))
    _check(random_cameras(3, spread=spread), grid, feature_size, rays_per_cell)


@pytest.mark.parametrize("spread", [0.3, 6.0], ids=["inside", "outside"])
def test_equals_the_pair_list_where_pictures_fill_a_part(random_cameras, spread):
    picture = torch.tensor([[0.0, 0.0, 80.0, 60.0], [21.0, 0.0, 47.0, 60.0], [30.0, 20.0, 31.0, 21.0]])
    cameras = replace(random_cameras(3, spread=spread), picture=picture.double())
    grid = VoxelGrid((9, 5, 6), (4.1, 2.3, 2.7), torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64))
    _check(cameras, grid, (5, 9), 2)
    nothing = replace(cameras, picture=torch.zeros(3, 4, dtype=torch.float64))
    blocks, number = trace_blocks(*_on_device(nothing, grid), (5, 9), 2)
    assert (len(blocks), int(number)) == (0, 0)


def test_equals_the_pair_list_of_a_batch(random_cameras, generator):
    center = torch.randn(2, 3, generator=generator)
    _check(random_cameras(2, 2, spread=0.8), VoxelGrid((5, 4, 9), (3.0, 3.0, 2.0), center), (5, 3), 1)


def test_equals_the_pair_list_where_rays_hit_edges_and_corners_and_run_in_faces():
    # As in test_traverse: focal length, principal point and poses are dyadic, all rays are exact.
    intrinsics = torch.tensor([[2.0, 0.0, 2.5], [0.0, 2.0, 2.5], [0.0, 0.0, 1.0]])
    poses = []
    for offset in (-3.0, -1.0, 0.0, 0.25):
        for axes, sign in (([0, 1, 2], 1.0), ([1, 2, 0], -1.0), ([2, 1, 0], 1.0)):
            pose = torch.eye(4)
            pose[:3, :3] = torch.eye(3)[axes] * torch.tensor([sign, 1.0, sign])
            pose[:3, 3] = torch.tensor([offset, offset / 2, 0.0])[axes]
            poses.append(pose)
    cameras = Cameras(intrinsics.expand(len(poses), 3, 3), torch.stack(poses), (5, 5))
    _check(cameras, VoxelGrid((4, 5, 2), (4.0, 5.0, 2.0), torch.zeros(3)), (5, 5), 1)


def test_equals_the_pair_list_for_grazing_cameras(random_cameras, generator):
    cameras = random_cameras(9, spread=1.0)
    pose = cameras.world_from_camera.clone()
    for i in range(9):
        axis = i % 3
        pose[i, axis, 3] = [-1.5, 1.0, 0.75][axis] + [0.0, 1e-5, -1e-5][i // 3]
        forward = torch.randn(3, generator=generator, dtype=torch.float64)
        forward[axis] *= 1e-3
        right = torch.linalg.cross(forward, torch.randn(3, generator=generator, dtype=torch.float64))
        columns = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
        pose[i, :3, :3] = columns / columns.norm(dim=0)
    grid = VoxelGrid((6, 4, 3), (3.0, 2.0, 1.5), torch.zeros(3, dtype=torch.float64))
    _check(Cameras(cameras.intrinsics, pose, cameras.image_size), grid, (3, 5), 1)


def test_no_ray_hits(random_cameras):
    grid = VoxelGrid((2, 2, 2), (1.0, 1.0, 1.0), torch.full((3,), 1e4))
    blocks, number = trace_blocks(*_on_device(random_cameras(1, spread=0.1), grid), (2, 2), 1)
    assert (len(blocks), int(number)) == (0, 0)
    assert blocks.pixels_per_voxel().tolist() == [0] * 8


def test_scenes_of_cameras_and_grid_must_agree(random_cameras):
    grid = VoxelGrid((2, 2, 2), (1.0, 1.0, 1.0), torch.zeros(3, 3))
    with pytest.raises(ShapeError, match="leading shape"):
        trace_blocks(*_on_device(random_cameras(2, 3, spread=1.0), grid))


@pytest.mark.parametrize("room", [0, 5, 50])
def test_room_for_fewer_or_more_block_pairs_than_there_are(random_cameras, room):
    here = _on_device(
        random_cameras(3, spread=0.3), VoxelGrid((12, 12, 8), (4.0, 4.0, 3.0), torch.zeros(3).double())
    )
    exact, number = trace_blocks(*here, (4, 8), 1)
    blocks, same_number = trace_blocks(*here, (4, 8), 1, capacity=room)
    assert 5 < int(number) < 50
    assert int(same_number) == int(number)
    assert len(blocks) == room
    kept = min(room, len(exact))
    assert torch.equal(blocks.key[:kept], exact.key[:kept])
    assert torch.equal(blocks.masks[:kept], exact.masks[:kept])
    assert not blocks.masks[kept:].any()
    if room >= len(exact):
        assert torch.equal(torch.stack(blocks.index()), torch.stack(exact.index()))
        assert torch.equal(blocks.pixels_per_voxel(), exact.pixels_per_voxel())


@pytest.mark.parametrize("attention", ["auto", "fused", "sparse"])
def test_tracer_gives_pairs_for_the_attention_that_is_asked_for(random_cameras, attention):
    here = _on_device(random_cameras(2, spread=0.5), VoxelGrid((6, 5, 4), (3.0, 2.0, 2.0), torch.zeros(3)))
    pairs = RayTracer(attention)(*here, (4, 8), 1)
    exact = trace_pairs(*here, (4, 8), 1)
    fused = attention == "fused" or (attention == "auto" and DEVICE == "cuda")
    assert isinstance(pairs, BlockPairs if fused else PairList)
    assert torch.equal(
        torch.stack(pairs.index() if fused else (pairs.pixel_index, pairs.voxel_index)),
        torch.stack([exact.pixel_index, exact.voxel_index]),
    )
    if not fused:
        assert pairs.fused == (attention == "auto")


def test_every_pair_is_there_however_many_the_step_before_had(random_cameras):
    tracer, center = RayTracer("fused"), torch.zeros(3, dtype=torch.float64)
    cameras = random_cameras(1, spread=0.1)
    for side in (4, 16):  # one block, then many
        here = _on_device(cameras, VoxelGrid((side, side, side), (3.0, 3.0, 3.0), center))
        exact = trace_pairs(*here, (4, 16), 1)
        assert len(tracer(*here, (4, 16), 1).index()[0]) == len(exact)


def test_pairs_may_be_traced_without_waiting_for_their_number(random_cameras, monkeypatch):
    """The first ones are waited for; then there is room for twice the most, and it is heard if that lacks."""
    monkeypatch.setattr(traverse, "_LEAST_ROOM", 0)
    grid = VoxelGrid((8, 8, 8), (3.0, 3.0, 3.0), torch.zeros(3, dtype=torch.float64))
    rays = (*_on_device(random_cameras(1, spread=0.1), grid), (4, 16), 1)
    tracer = RayTracer("fused")
    exact = tracer.without_waiting(*rays)
    assert tracer.fits is None
    tracer._most = dict.fromkeys(tracer._most, len(exact) // 4)  # as if the step before had fewer
    lacking = tracer.without_waiting(*rays)
    assert len(lacking) == 2 * (len(exact) // 4) < len(exact)
    assert not tracer.fits
    if DEVICE == "cuda":
        torch.cuda.synchronize()
    enough = tracer.without_waiting(*rays)
    assert len(enough) == 2 * len(exact)
    assert tracer.fits
    assert torch.equal(torch.stack(enough.index()), torch.stack(exact.index()))
    assert len(tracer(*rays)) == len(exact)
    assert tracer.fits is None


def test_fused_attention_that_cannot_run_is_refused(random_cameras, monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    grid = VoxelGrid((3, 2, 2), (3.0, 2.0, 2.0), torch.zeros(3))
    with pytest.raises(
        ConfigError, match="attention=fused needs a GPU with Triton, but tensors are on the CPU"
    ):
        RayTracer("fused")(random_cameras(2, spread=0.5), grid, (3, 4), 1)
    with pytest.raises(ConfigError, match="unknown attention=dense: choose one of auto, fused, sparse"):
        RayTracer("dense")


def test_tracer_without_kernels_lists_the_pairs(random_cameras):
    grid = VoxelGrid((3, 2, 2), (3.0, 2.0, 2.0), torch.zeros(3))
    pairs = RayTracer()(random_cameras(2, spread=0.5), grid, (3, 4), 1)
    assert isinstance(pairs, PairList)


def test_equals_the_pair_list_where_float32_cannot_tell(generator):
    # From 5,000 voxels away float32 is off by a thousandth of a voxel: the kernels must look again.
    grid = VoxelGrid((8, 8, 8), (0.4, 0.4, 0.4), torch.zeros(3, dtype=torch.float64))
    intrinsics = torch.tensor([[9000.0, 0.0, 8.0], [0.0, 9000.0, 8.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    away = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=-1)
    pose = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    side = torch.nn.functional.normalize(torch.linalg.cross(away, away.roll(1, dims=-1)), dim=-1)
    pose[:, :3, :3] = torch.stack([side, torch.linalg.cross(-away, side), -away], dim=-1)
    pose[:, :3, 3] = 250.0 * away
    _check(Cameras(intrinsics.expand(2, 3, 3), pose, (16, 16)), grid, (16, 16), 2)
