# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.errors import ShapeError
from raytran.geometry.grid import VoxelGrid


def test_paper_grid():
    grid = VoxelGrid((48, 48, 16), (9.0, 9.0, 3.5), torch.tensor([1.0, 2.0, 3.0]))
    assert grid.num_voxels == 36864
    assert grid.voxel_size.tolist() == [0.1875, 0.1875, 0.21875]
    assert grid.lower.tolist() == [-3.5, -2.5, 1.25]


def test_voxels_are_numbered_x_major_and_z_fastest():
    grid = VoxelGrid((3, 4, 5), (3.0, 8.0, 2.5), torch.zeros(3))
    assert grid.flat_index(torch.tensor([[0, 0, 1], [0, 1, 0], [1, 0, 0], [2, 3, 4]])).tolist() == [
        1,
        5,
        20,
        59,
    ]
    centers = grid.voxel_centers()
    assert centers.shape == (3, 4, 5, 3)
    assert centers[2, 0, 1].tolist() == [1.0, -3.0, -0.5]
    index = grid.voxel_from_world(centers.reshape(-1, 3)).floor().long()
    assert grid.flat_index(index).tolist() == list(range(60))


def test_world_and_voxel_coordinates_are_inverse_in_every_scene():
    grid = VoxelGrid((3, 4, 5), (3.0, 8.0, 2.5), torch.tensor([[0.0, 0.0, 0.0], [10.0, 20.0, 30.0]]).double())
    assert grid.world_from_voxel(torch.zeros(1, 3).double())[1].tolist() == [[8.5, 16.0, 28.75]]
    points = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(grid.world_from_voxel(grid.voxel_from_world(points)), points)
    assert grid.voxel_centers().shape == (2, 3, 4, 5, 3)


def test_center_must_be_a_point():
    with pytest.raises(ShapeError, match="expected center"):
        VoxelGrid((3, 4, 5), (1, 1, 1), torch.zeros(2))


def test_a_center_of_whole_numbers_is_not_cut_to_whole_metres():
    grid = VoxelGrid((48, 48, 16), (9.0, 9.0, 3.5), (0, 0, 0))
    torch.testing.assert_close(grid.lower, torch.tensor([-4.5, -4.5, -1.75]))
