# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import torch

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid, position_code, ray_code


def test_lowest_wave_spans_twice_the_volume_and_highest_a_sixteenth() -> None:
    """Steps along y only; with 24 channels each axis has four sines, then four cosines."""
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 4.5, 0.0], [0.0, 9 / 64, 0.0]])
    code = position_code(points, (9.0, 9.0, 3.5), 24)
    of_y = code[:, 8:16]
    assert code.shape == (3, 24)
    # A quarter of the wave of 18 m, and a quarter of that of 9/16 m.
    assert math.isclose(float(of_y[1, 0]), 1.0, abs_tol=1e-6)
    assert math.isclose(float(of_y[2, 3]), 1.0, abs_tol=1e-6)
    torch.testing.assert_close(code[1, :8], code[0, :8])


def test_any_number_of_channels() -> None:
    code = position_code(torch.randn(2, 5, 3), (1.0, 1.0, 1.0), 64)
    assert code.shape == (2, 5, 64)
    assert not code[..., 60:].any()


def test_rays_are_told_from_the_grids_centre_with_unit_direction() -> None:
    pose = torch.eye(4).repeat(1, 2, 1, 1)  # looks along +z
    pose[0, :, :3, 3] = torch.tensor([[1.0, 2.0, 3.0], [4.0, 2.0, 3.0]])
    intrinsics = torch.tensor([[30.0, 0, 24], [0, 30, 24], [0, 0, 1]]).expand(1, 2, 3, 3)
    grid = VoxelGrid((4, 4, 4), (4.0, 4.0, 4.0), torch.tensor([[1.0, 0.0, 0.0]]))
    code = ray_code(Cameras(intrinsics, pose, (48, 48)), grid, (3, 3))
    assert code.shape == (2, 3, 3, 6)
    torch.testing.assert_close(code[1, 1, 1], torch.tensor([3.0, 2.0, 3.0, 0.0, 0.0, 1.0]))
    # The corner cell's centre is 16 pixels left and up of the middle.
    corner = torch.nn.functional.normalize(torch.tensor([-16.0, -16.0, 30.0]), dim=0)
    torch.testing.assert_close(code[0, 0, 0], torch.cat([torch.tensor([0.0, 2.0, 3.0]), corner]))
