# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.errors import ShapeError
from raytran.geometry.camera import Cameras

K = torch.tensor([[500.0, 0.0, 310.0], [0.0, 480.0, 250.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def _pose(seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation * torch.linalg.det(rotation)
    pose[:3, 3] = torch.tensor([3.0, -2.0, 1.5])
    return pose


def test_projection_by_hand():
    # A camera at (1, 2, 3) looking along +x of the world: right is -y, down is -z.
    pose = torch.tensor(
        [[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, -1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
    ).double()
    pixels, depth = Cameras(K, pose, (480, 640)).project(torch.tensor([[5.0, 1.0, 3.5]]).double())
    # In the camera: x = 1, y = -0.5, z = 4.
    assert depth.tolist() == [4.0]
    assert pixels.tolist() == [[310 + 500 / 4, 250 - 480 * 0.5 / 4]]


def test_depth_of_a_point_behind_the_camera_is_negative_and_its_pixel_finite_on_the_plane():
    cameras = Cameras(K, torch.eye(4).double(), (480, 640))
    pixels, depth = cameras.project(torch.tensor([[0.0, 0.0, -2.0], [1.0, 1.0, 0.0]]).double())
    assert depth.tolist() == [-2.0, 0.0]
    assert pixels.isfinite().all()


def test_resizing_moves_image_points_with_the_image():
    # Not keeping the aspect, as 540×360 frames that are read as 640×480.
    cameras = Cameras(K, _pose(), (360, 540))
    points = cameras.position + torch.randn(10, 3, generator=torch.Generator().manual_seed(1)).double()
    before, depth = cameras.project(points)
    after, same_depth = cameras.scaled_to((480, 640)).project(points)
    torch.testing.assert_close(after, before * torch.tensor([640 / 540, 480 / 360]).double())
    assert torch.equal(depth, same_depth)
    assert cameras.scaled_to((480, 640)).image_size == (480, 640)


@pytest.mark.parametrize("rays_per_cell", [1, 2, 3])
def test_rays_pass_through_the_centres_of_the_parts_of_their_cells(rays_per_cell):
    n = rays_per_cell
    cameras = Cameras(K, _pose(), (480, 640))
    origins, directions = cameras.cell_rays((3, 4), n)
    assert origins.shape == (1, 1, 1, 3)
    assert directions.shape == (3, 4, n * n, 3)
    pixels, depth = cameras.project((origins + 2.5 * directions).reshape(-1, 3))
    pixels = pixels.reshape(3, 4, n, n, 2)
    torch.testing.assert_close(depth, torch.full_like(depth, 2.5))
    for row, column, i, j in ((0, 0, 0, 0), (2, 1, n - 1, 0), (1, 3, 0, n - 1)):
        u = (column + (j + 0.5) / n) * 640 / 4
        v = (row + (i + 0.5) / n) * 480 / 3
        torch.testing.assert_close(pixels[row, column, i, j], torch.tensor([u, v]).double())


def test_leading_dimensions_are_cameras():
    poses = torch.stack([_pose(seed) for seed in range(6)]).reshape(2, 3, 4, 4)
    together = Cameras(K.expand(2, 3, 3, 3), poses, (480, 640))
    origins, directions = together.cell_rays((3, 4), 2)
    assert origins.shape == (2, 3, 1, 1, 1, 3)
    points = torch.randn(7, 3, generator=torch.Generator().manual_seed(1)).double()
    pixels, depth = together.project(points)
    assert pixels.shape == (2, 3, 7, 2)
    alone = Cameras(K, poses[1, 2], (480, 640))
    torch.testing.assert_close(directions[1, 2], alone.cell_rays((3, 4), 2)[1])
    torch.testing.assert_close(pixels[1, 2], alone.project(points)[0])
    torch.testing.assert_close(depth[1, 2], alone.project(points)[1])


def test_wrong_shapes():
    with pytest.raises(ShapeError, match="expected intrinsics"):
        Cameras(torch.eye(4), torch.eye(4), (480, 640))
    with pytest.raises(ShapeError, match="expected world_from_camera"):
        Cameras(torch.eye(3), torch.eye(3), (480, 640))
    with pytest.raises(ShapeError, match="as many intrinsics as poses"):
        Cameras(torch.eye(3).expand(2, 3, 3), torch.eye(4).expand(3, 4, 4), (480, 640))
