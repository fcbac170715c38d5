# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import torch

from raytran.extensions.unprojection import pair_centers
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid

FEATURE_SIZE = (4, 6)


def make_scenes(generator: torch.Generator) -> tuple[Cameras, VoxelGrid]:
    """Two scenes of three cameras that look along +y from inside the grid: much lies beside or behind."""
    pose = torch.eye(4).repeat(2, 3, 1, 1)
    pose[..., :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[..., :3, 3] = torch.rand(2, 3, 3, generator=generator) - torch.tensor([0.5, 1.5, 0.5])
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(2, 3, 3, 3)
    center = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.3, -0.2]])
    return Cameras(intrinsics, pose, (32, 48)), VoxelGrid((5, 6, 4), (5.0, 6.0, 3.0), center)


def pairs_one_by_one(cameras: Cameras, grid: VoxelGrid) -> set[tuple[int, int]]:
    found = set()
    for scene in range(2):
        centers = grid.voxel_centers()[scene].reshape(-1, 3)
        for view in range(3):
            camera_from_world = torch.linalg.inv(cameras.world_from_camera[scene, view])
            for voxel, point in enumerate(centers):
                x, y, z, _ = camera_from_world @ torch.cat([point, torch.ones(1)])
                column, row = ((40 * x / z + 24) / 8).floor(), ((40 * y / z + 16) / 8).floor()
                if z > 0 and 0 <= row < FEATURE_SIZE[0] and 0 <= column < FEATURE_SIZE[1]:
                    cell = ((scene * 3 + view) * FEATURE_SIZE[0] + int(row)) * FEATURE_SIZE[1] + int(column)
                    found.add((cell, scene * grid.num_voxels + voxel))
    return found


def test_voxels_meet_the_cells_under_their_centres(generator: torch.Generator) -> None:
    cameras, grid = make_scenes(generator)
    pairs = pair_centers(cameras, grid, FEATURE_SIZE)
    found = list(zip(pairs.pixel_index.tolist(), pairs.voxel_index.tolist(), strict=True))
    assert found == sorted(found)
    assert set(found) == pairs_one_by_one(cameras, grid)
    assert (pairs.num_pixels, pairs.num_voxels) == (2 * 3 * 4 * 6, 2 * 120)
    seen = pairs.pixels_per_voxel()
    assert seen.max() == 3  # one pixel a view
    assert seen.min() == 0


def test_one_scene_may_come_without_a_batch(generator: torch.Generator) -> None:
    cameras, grid = make_scenes(generator)
    alone = Cameras(cameras.intrinsics[0], cameras.world_from_camera[0], cameras.image_size)
    pairs = pair_centers(alone, VoxelGrid(grid.resolution, grid.extent, grid.center[0]), FEATURE_SIZE)
    both = pair_centers(cameras, grid, FEATURE_SIZE)
    first = both.voxel_index < grid.num_voxels
    assert torch.equal(pairs.pixel_index, both.pixel_index[first])
    assert torch.equal(pairs.voxel_index, both.voxel_index[first])


def test_cameras_that_see_nothing_pair_nothing(generator: torch.Generator) -> None:
    cameras, grid = make_scenes(generator)
    away = VoxelGrid(grid.resolution, grid.extent, grid.center - torch.tensor([0.0, 50.0, 0.0]))
    assert len(pair_centers(cameras, away, FEATURE_SIZE)) == 0


def test_voxels_outside_of_a_picture_are_not_seen(generator: torch.Generator) -> None:
    cameras, grid = make_scenes(generator)
    # Columns 2 and 3 of six, 8 pixels each.
    picture = torch.tensor([16.0, 0.0, 32.0, 32.0]).expand(2, 3, 4)
    pairs = pair_centers(replace(cameras, picture=picture), grid, FEATURE_SIZE)
    whole = pair_centers(cameras, grid, FEATURE_SIZE)
    inside = (whole.pixel_index % 6).ge(2) & (whole.pixel_index % 6).lt(4)
    assert 0 < inside.sum() < len(whole)
    assert torch.equal(pairs.pixel_index, whole.pixel_index[inside])
    assert torch.equal(pairs.voxel_index, whole.voxel_index[inside])
