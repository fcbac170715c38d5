# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import itertools
from dataclasses import replace
from fractions import Fraction
from math import floor
from pathlib import Path

import numpy as np
import pytest
import torch

from raytran.errors import ShapeError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops import reference
from raytran.ops.pairs import PairList
from raytran.ops.traverse import count_views, trace_pairs


def _assert_equal(actual: PairList, expected: PairList) -> None:
    assert actual.num_pixels == expected.num_pixels
    assert actual.num_voxels == expected.num_voxels
    assert torch.equal(actual.pixel_index, expected.pixel_index)
    assert torch.equal(actual.voxel_index, expected.voxel_index)


@pytest.mark.parametrize("rays_per_cell", [1, 2, 3])
@pytest.mark.parametrize("spread", [0.3, 1.5, 6.0], ids=["inside", "around", "outside"])
def test_equals_slab_test_of_every_voxel(random_cameras, spread, rays_per_cell):
    cameras = random_cameras(12, spread=spread)
    grid = VoxelGrid((6, 5, 3), (3.1, 2.3, 1.7), torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64))
    actual = trace_pairs(cameras, grid, (3, 4), rays_per_cell)
    assert len(actual) > 10
    _assert_equal(actual, reference.trace_pairs(cameras, grid, (3, 4), rays_per_cell))


def test_equals_slab_test_of_every_voxel_for_grazing_cameras(random_cameras, generator):
    # Cameras on, and a hair inside and outside of, the grid's faces, looking along them.
    cameras = random_cameras(36, spread=1.0)
    pose = cameras.world_from_camera.clone()
    face = torch.tensor([-1.5, 1.0, 0.75], dtype=torch.float64)
    hair = torch.tensor([0.0, 1e-5, -1e-5], dtype=torch.float64).repeat(12)
    for i in range(36):
        axis = i % 3
        pose[i, axis, 3] = face[axis] + hair[i // 3]
        forward = torch.randn(3, generator=generator, dtype=torch.float64)
        forward[axis] *= 1e-3
        right = torch.linalg.cross(forward, torch.randn(3, generator=generator, dtype=torch.float64))
        down = torch.linalg.cross(forward, right)
        columns = torch.stack([right, down, forward], dim=1)
        pose[i, :3, :3] = columns / columns.norm(dim=0)
    cameras = Cameras(cameras.intrinsics, pose, cameras.image_size)
    grid = VoxelGrid((6, 4, 3), (3.0, 2.0, 1.5), torch.zeros(3, dtype=torch.float64))
    actual = trace_pairs(cameras, grid, (3, 5), 1)
    assert len(actual) > 100
    _assert_equal(actual, reference.trace_pairs(cameras, grid, (3, 5), 1))


PICTURES = [[0.0, 0, 80, 60], [21.0, 0, 47, 60], [0.0, 13, 80, 31], [30.0, 20, 31, 21]]
"""In images of 80×60: all of it, the middle columns, some rows, and a pixel that no ray passes through."""


@pytest.mark.parametrize("rays_per_cell", [1, 2, 3])
@pytest.mark.parametrize("spread", [0.3, 1.5], ids=["inside", "around"])
def test_equals_slab_test_of_every_voxel_where_pictures_fill_a_part(random_cameras, spread, rays_per_cell):
    picture = torch.tensor(PICTURES, dtype=torch.float64).repeat(3, 1)
    cameras = replace(random_cameras(12, spread=spread), picture=picture)
    grid = VoxelGrid((6, 5, 3), (3.1, 2.3, 1.7), torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64))
    actual = trace_pairs(cameras, grid, (3, 4), rays_per_cell)
    whole = trace_pairs(replace(cameras, picture=None), grid, (3, 4), rays_per_cell)
    assert 10 < len(actual) < len(whole)
    _assert_equal(actual, reference.trace_pairs(cameras, grid, (3, 4), rays_per_cell))
    everything = picture.new_tensor(PICTURES[0]).expand(12, 4)
    _assert_equal(trace_pairs(replace(cameras, picture=everything), grid, (3, 4), rays_per_cell), whole)


def test_a_picture_within_a_larger_image_gives_the_pairs_of_its_own(random_cameras):
    """The same frame, 16 wide in an image of 48: its cells are columns 2 and 3 of six."""
    own = random_cameras(5, spread=0.5)
    own = Cameras(own.intrinsics, own.world_from_camera, (32, 16))
    shift = torch.tensor([[0.0, 0, 16], [0, 0, 0], [0, 0, 0]], dtype=torch.float64)
    picture = torch.tensor([16.0, 0.0, 32.0, 32.0], dtype=torch.float64).expand(5, 4)
    padded = Cameras(own.intrinsics + shift, own.world_from_camera, (32, 48), picture)
    grid = VoxelGrid((6, 5, 3), (3.1, 2.3, 1.7), torch.zeros(3, dtype=torch.float64))
    expected, actual = trace_pairs(own, grid, (4, 2)), trace_pairs(padded, grid, (4, 6))
    row, column = actual.pixel_index // 6, actual.pixel_index % 6
    assert torch.equal(row * 2 + column - 2, expected.pixel_index)
    assert torch.equal(actual.voxel_index, expected.voxel_index)
    assert torch.equal(count_views(padded, grid, (4, 6)), count_views(own, grid, (4, 2)))


def _exact_voxels(origin: list[Fraction], ray: list[Fraction], resolution: tuple[int, ...]) -> set[int]:
    """Voxels around the middle of each stretch between two crossings, in rational numbers."""
    crossings = {Fraction(0)}
    for o, d, n in zip(origin, ray, resolution, strict=True):
        crossings |= {(i - o) / d for i in range(n + 1) if d != 0 and (i - o) / d > 0}
    found = set()
    for near, far in itertools.pairwise(sorted(crossings)):
        index = [floor(o + d * (near + far) / 2) for o, d in zip(origin, ray, strict=True)]
        if all(0 <= i < n for i, n in zip(index, resolution, strict=True)):
            found.add((index[0] * resolution[1] + index[1]) * resolution[2] + index[2])
    return found


@pytest.mark.parametrize("offset", [-3.0, -2.0, -1.0, 0.0, 0.25, 2.0, 2.5])
def test_equals_rational_arithmetic_where_every_ray_hits_edges_and_corners(offset):
    # Focal length, principal point and poses are dyadic: all rays are exact, and run through edges, corners
    # and (the middle row and column of 5×5) inside faces, parallel to one or two axes.
    intrinsics = torch.tensor([[2.0, 0.0, 2.5], [0.0, 2.0, 2.5], [0.0, 0.0, 1.0]])
    resolution = (4, 4, 2)
    grid = VoxelGrid(resolution, (4.0, 4.0, 2.0), torch.zeros(3))
    poses = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            pose = torch.eye(4)
            pose[:3, :3] = torch.eye(3)[list(order)] * torch.tensor(signs)
            pose[:3, 3] = torch.tensor([offset, offset / 2, 0.0])[list(order)]
            poses.append(pose)
    cameras = Cameras(intrinsics.expand(len(poses), 3, 3), torch.stack(poses), (5, 5))
    actual = trace_pairs(cameras, grid, (5, 5), 1)

    expected = []
    for view, pose in enumerate(poses):
        origin = [Fraction(float(p)) + Fraction(n, 2) for p, n in zip(pose[:3, 3], resolution, strict=True)]
        for row, column in itertools.product(range(5), repeat=2):
            ray = pose[:3, :3] @ torch.tensor([(column - 2) / 2, (row - 2) / 2, 1.0])
            voxels = _exact_voxels(origin, [Fraction(float(d)) for d in ray], resolution)
            expected += [(view * 25 + row * 5 + column, voxel) for voxel in sorted(voxels)]
    assert torch.stack([actual.pixel_index, actual.voxel_index], 1).tolist() == [
        list(pair) for pair in expected
    ]


def test_ray_in_a_face_belongs_to_the_larger_side_even_when_the_pose_is_rounded():
    # Looking along +x by a rotation whose zeros are 6e-17, from a point on the plane between y cells 0 and 1.
    quarter = torch.tensor(torch.pi / 2, dtype=torch.float64)
    zero, one = torch.cos(quarter), torch.sin(quarter)
    rows = [[zero, zero, one, -5.0], [-one, zero, zero, 0.1 + 0.2], [zero, -one, zero, 0.5]]
    pose = torch.tensor([*rows, [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    intrinsics = torch.tensor([[[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]]], dtype=torch.float64)
    grid = VoxelGrid((3, 2, 1), (3.0, 2.0, 1.0), torch.tensor([1.5, 0.3, 0.5], dtype=torch.float64))
    for sign in (1.0, -1.0):
        turned = pose.clone()
        turned[1, 2] *= sign
        pairs = trace_pairs(Cameras(intrinsics, turned[None], (1, 1)), grid, (1, 1), 1)
        assert pairs.voxel_index.tolist() == [1, 3, 5]


def test_one_ray_by_hand():
    # y = x + ¼: the ray crosses y=1 at x=¾, x=1, y=2 at x=1¾, x=2, and leaves through y=3.
    cameras = _camera_towards([0.25, 0.5, 0.5], [1.0, 1.0, 0.0])
    grid = VoxelGrid((3, 3, 1), (3.0, 3.0, 1.0), torch.tensor([1.5, 1.5, 0.5]))
    assert trace_pairs(cameras, grid, (1, 1), 1).voxel_index.tolist() == [0, 1, 4, 5, 8]


def test_voxels_behind_the_camera_do_not_count():
    grid = VoxelGrid((4, 1, 1), (4.0, 1.0, 1.0), torch.tensor([2.0, 0.5, 0.5]))
    for start, expected in ((-1.0, [0, 1, 2, 3]), (1.5, [1, 2, 3]), (2.0, [2, 3]), (4.0, []), (9.0, [])):
        pairs = trace_pairs(_camera_towards([start, 0.5, 0.5], [1, 0, 0]), grid, (1, 1), 1)
        assert pairs.voxel_index.tolist() == expected


def _camera_towards(position: list[float], forward: list[float]) -> Cameras:
    z = torch.nn.functional.normalize(torch.tensor(forward).float(), dim=0)
    x = torch.linalg.cross(torch.tensor([0.0, 0.0, -1.0]), z)
    pose = torch.eye(4)
    pose[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z], dim=1)
    pose[:3, 3] = torch.tensor(position)
    return Cameras(torch.tensor([[[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]]]), pose[None], (1, 1))


def test_more_rays_only_add_pairs_and_pairs_are_sorted_and_unique(random_cameras):
    cameras = random_cameras(4, spread=1.0)
    grid = VoxelGrid((9, 8, 5), (4.0, 4.0, 2.0), torch.zeros(3))
    one, three = (trace_pairs(cameras, grid, (6, 8), n) for n in (1, 3))
    keys = [p.pixel_index * p.num_voxels + p.voxel_index for p in (one, three)]
    assert all((key.diff() > 0).all() for key in keys)
    assert torch.isin(keys[0], keys[1]).all()  # the centre ray is one of the nine
    assert len(three) > len(one)


def test_batch_equals_its_scenes_alone(random_cameras, generator):
    cameras = random_cameras(2, 3, spread=0.8)
    center = torch.randn(2, 3, generator=generator)
    both = trace_pairs(cameras, VoxelGrid((5, 4, 3), (3.0, 3.0, 2.0), center), (3, 4))
    pixels, voxels = [], []
    for scene in range(2):
        alone = trace_pairs(
            Cameras(cameras.intrinsics[scene], cameras.world_from_camera[scene], cameras.image_size),
            VoxelGrid((5, 4, 3), (3.0, 3.0, 2.0), center[scene]),
            (3, 4),
        )
        assert (alone.num_pixels, alone.num_voxels) == (36, 60)
        pixels.append(alone.pixel_index + scene * 36)
        voxels.append(alone.voxel_index + scene * 60)
    _assert_equal(both, PairList(torch.cat(pixels), torch.cat(voxels), 72, 120))


def test_does_not_depend_on_how_many_rays_are_traced_at_once(random_cameras, monkeypatch):
    cameras = random_cameras(3, spread=1.0)
    grid = VoxelGrid((9, 8, 5), (4.0, 4.0, 2.0), torch.zeros(3))
    expected = trace_pairs(cameras, grid, (6, 8))
    monkeypatch.setattr("raytran.ops.traverse._AT_ONCE", {"cpu": 70})
    _assert_equal(trace_pairs(cameras, grid, (6, 8)), expected)


def test_no_ray_hits():
    grid = VoxelGrid((2, 2, 2), (1, 1, 1), torch.zeros(3))
    pairs = trace_pairs(_camera_towards([50.0, 0.0, 0.0], [1, 0, 0]), grid)
    assert len(pairs) == 0
    assert pairs.pixel_index.dtype == torch.int64
    assert (pairs.num_pixels, pairs.num_voxels) == (1200, 8)


def test_scenes_of_cameras_and_grid_must_agree(random_cameras):
    with pytest.raises(ShapeError, match="leading shape"):
        trace_pairs(random_cameras(2, 3, spread=1.0), VoxelGrid((2, 2, 2), (1, 1, 1), torch.zeros(3, 3)))
    with pytest.raises(ShapeError, match="leading shape"):
        trace_pairs(random_cameras(3, spread=1.0), VoxelGrid((2, 2, 2), (1, 1, 1), torch.zeros(1, 3)))


def test_views_are_counted_from_the_pairs(random_cameras):
    cameras = random_cameras(19, spread=1.0)
    grid = VoxelGrid((6, 5, 3), (3.1, 2.3, 1.7), torch.zeros(3, dtype=torch.float64))
    pairs = trace_pairs(cameras, grid, (3, 4), 2)
    met = torch.zeros(19, grid.num_voxels, dtype=torch.bool)
    met[pairs.pixel_index // 12, pairs.voxel_index] = True
    counts = count_views(cameras, grid, (3, 4), 2)
    assert counts.shape == (6, 5, 3)
    assert 8 < counts.max() <= 19
    assert torch.equal(counts.flatten(), met.sum(dim=0, dtype=torch.int32))
    away = VoxelGrid((6, 5, 3), (0.1, 0.1, 0.1), torch.full((3,), 1e3, dtype=torch.float64))
    assert count_views(cameras, away, (3, 4), 2).sum() == 0
    with pytest.raises(ShapeError, match="intrinsics of shape"):
        count_views(random_cameras(2, 3, spread=1.0), grid, (3, 4))


def _lounge_cameras(scan: Path, count: int) -> Cameras:
    frames = sorted(int(path.stem) for path in (scan / "pose").glob("*.txt"))
    frames = [frames[i] for i in np.linspace(0, len(frames) - 1, count).round().astype(int)]
    poses = torch.tensor(np.stack([np.loadtxt(scan / "pose" / f"{i}.txt") for i in frames]))
    intrinsics = torch.tensor(np.loadtxt(scan / "intrinsic" / "intrinsic_color.txt")[:3, :3])
    return Cameras(intrinsics.expand(count, 3, 3), poses, (360, 540))


def test_numbers_of_pairs_on_a_real_camera_path(shared_dir):
    cameras = _lounge_cameras(shared_dir / "realdata" / "hololens_lounge" / "scans" / "hololens_000", 20)
    grid = VoxelGrid((48, 48, 16), (9.0, 9.0, 3.5), cameras.position.mean(dim=0))
    assert len(trace_pairs(cameras, grid, (30, 40), 1)) == pytest.approx(820_000, rel=0.01)
    assert len(trace_pairs(cameras, grid, (30, 40), 2)) == pytest.approx(1_050_000, rel=0.01)
