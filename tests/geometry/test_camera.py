# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.errors import ShapeError
from raytran.geometry.camera import Cameras, other_image_size

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


PICTURE = torch.tensor([[16.0, 0.0, 32.0, 30.25], [0.0, 4.0, 48.0, 32.0]])


def pair_of_cameras() -> Cameras:
    intrinsics = torch.tensor([[40.0, 0, 20], [0, 42, 18], [0, 0, 1]]).expand(2, 3, 3)
    pose = torch.stack([_pose(1), _pose(2)]).float()
    return Cameras(intrinsics, pose, (32, 48), PICTURE)


def test_cameras_are_chosen_scaled_and_moved_with_their_pictures():
    cameras = pair_of_cameras()
    assert cameras[1].picture.tolist() == PICTURE[1].tolist()
    assert cameras[[1, 0]].picture.tolist() == PICTURE[[1, 0]].tolist()
    assert cameras[None][:, 1:].intrinsics.shape == (1, 1, 3, 3)
    assert cameras.scaled_to((16, 96)).picture.tolist() == [[32, 0, 64, 15.125], [0, 2, 96, 16]]
    assert cameras.to(torch.float64).picture.dtype == torch.float64
    assert replace(cameras, picture=None)[0].picture is None


def test_a_camera_sees_what_is_in_its_picture_and_in_front():
    pixels = torch.tensor([[15.9, 1], [16, 0], [31.9, 29.9], [32, 10], [20, 30.25]]).expand(2, 5, 2)
    cameras, depth = pair_of_cameras(), torch.ones(2, 5)
    expected = [[False, True, True, False, False], [False, False, True, True, True]]
    assert cameras.sees(pixels, depth).tolist() == expected
    assert not cameras.sees(pixels, -depth).any()
    assert replace(cameras, picture=None).sees(pixels, depth).all()


def test_rays_through_the_picture_are_those_whose_points_are_in_it():
    cameras = pair_of_cameras()
    origin, directions = cameras.cell_rays((4, 6), 2)
    points = (origin + directions).flatten(1, 3)
    expected = cameras.sees(*cameras.project(points)).view(2, 4, 6, 4)
    assert torch.equal(cameras.cells_in_picture((4, 6), 2), expected)
    assert replace(cameras, picture=None).cells_in_picture((4, 6), 2) is None


@pytest.mark.parametrize("quarters", [1, 2, 3, 4])
def test_images_and_cameras_are_turned_together(quarters):
    cameras = pair_of_cameras()
    turned = cameras
    for _ in range(quarters):
        turned = turned.quarter_turned()
    assert turned.image_size == ((32, 48) if quarters % 2 == 0 else (48, 32))
    # What each pixel shows, as an image that is turned with numpy.
    pixels = np.stack(np.meshgrid(np.arange(48) + 0.5, np.arange(32) + 0.5), axis=-1)
    before = np.rot90(pixels, quarters).reshape(-1, 2).copy()
    height, width = turned.image_size
    after = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    homogeneous = torch.from_numpy(np.c_[before, np.ones(len(before))]).float()
    rays = torch.linalg.inv(cameras.intrinsics[0]) @ homogeneous.T
    pose = cameras.world_from_camera[0]
    points = (pose[:3, :3] @ rays).T * 2 + pose[:3, 3]
    seen, depth = turned[0].project(points)
    torch.testing.assert_close(seen, torch.from_numpy(after).float(), atol=1e-3, rtol=0)
    torch.testing.assert_close(depth, torch.full_like(depth, 2.0))
    in_picture = cameras[0].sees(torch.from_numpy(before), depth)
    assert torch.equal(turned[0].sees(torch.from_numpy(after), depth), in_picture)


def test_pictures_of_a_wrong_shape():
    for shape, message in (((2, 3), "expected picture of shape"), ((3, 4), "as many pictures as intrinsics")):
        with pytest.raises(ShapeError, match=message):
            replace(pair_of_cameras(), picture=torch.zeros(shape))


@pytest.mark.parametrize(
    ("center", "size", "other"),
    [
        ((320, 240), (480, 640), None),
        ((160, 120), (480, 640), (240, 320)),
        ((640, 480), (480, 640), (960, 1280)),
        ((240, 320), (480, 640), (640, 480)),
        ((259, 259), (720, 1280), (518, 518)),
        # Crops: the right half of an image, a strip from below its middle, a corner beyond it.
        ((0, 240), (480, 320), None),
        ((320, -100), (100, 640), None),
        ((-30, -40), (480, 640), None),
    ],
)
def test_for_which_other_images_intrinsics_are(center, size, other):
    assert other_image_size(center, size) == other


def test_a_principal_point_in_the_corner_is_that_of_no_image() -> None:
    assert other_image_size((0.2, 0.15), (48, 64)) is None
    assert other_image_size((320.0, 240.0), (48, 64)) == (480, 640)
