# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.backbone.block import Stream
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.heads.view import ViewHead
from raytran.ops.traverse import trace_pairs

CHANNELS = 16


def make_head(widths: tuple[int, ...] = (8, 8, 4)) -> ViewHead:
    torch.manual_seed(0)
    stream = Stream(channels=CHANNELS, num_heads=2, expansion=1, direction="voxels_to_pixels")
    return ViewHead(stream=stream, channels=CHANNELS, widths=widths)


def cameras_at(*positions: tuple[float, float, float], size: tuple[int, int] = (32, 48)) -> Cameras:
    """Cameras of one scene that look along +y."""
    pose = torch.eye(4).repeat(1, len(positions), 1, 1)
    pose[..., :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[0, :, :3, 3] = torch.tensor(positions)
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(1, len(positions), 3, 3)
    return Cameras(intrinsics, pose, size)


def render(head: ViewHead, voxels: torch.Tensor, cameras: Cameras, center: torch.Tensor) -> torch.Tensor:
    grid = VoxelGrid((6, 6, 4), (6.0, 6.0, 3.0), center)
    height, width = cameras.image_size
    pairs = trace_pairs(cameras, grid, (height // head.stride, width // head.stride), 2)
    return head(voxels, cameras, grid, pairs)


@pytest.mark.parametrize(("widths", "stride"), [((8, 8, 4), 16), ((8, 4), 8)])
def test_images_have_the_cameras_size(widths: tuple[int, ...], stride: int) -> None:
    head = make_head(widths)
    assert head.stride == stride
    voxels = torch.randn(1, 6, 6, 4, CHANNELS)
    for size in ((32, 48), (64, 16)):
        cameras = cameras_at((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), size=size)
        assert render(head, voxels, cameras, torch.zeros(1, 3)).shape == (1, 2, 3, *size)


def test_full_resolution_holds_three_channels() -> None:
    assert make_head().upsampler[-1].out_channels == 3


def test_a_camera_sees_the_voxels_on_its_rays_and_no_others() -> None:
    head, voxels = make_head(), torch.randn(1, 6, 6, 4, CHANNELS)
    camera, center = cameras_at((0.0, 0.0, 0.0)), torch.zeros(1, 3)
    seen = render(head, voxels, camera, center)
    behind, before = voxels.clone(), voxels.clone()
    behind[:, :, :3] += 1.0
    before[:, 3, 4] += 1.0
    torch.testing.assert_close(render(head, behind, camera, center), seen)
    assert not torch.allclose(render(head, before, camera, center), seen, atol=1e-4)


def test_a_camera_that_misses_the_volume_renders_something_finite() -> None:
    head = make_head()
    away = render(head, torch.randn(1, 6, 6, 4, CHANNELS), cameras_at((0.0, 50.0, 0.0)), torch.zeros(1, 3))
    other = render(head, torch.randn(1, 6, 6, 4, CHANNELS), cameras_at((0.0, 50.0, 0.0)), torch.zeros(1, 3))
    assert away.isfinite().all()
    torch.testing.assert_close(away, other)


def test_cameras_do_not_see_each_other_and_the_world_may_move() -> None:
    head, voxels = make_head(), torch.randn(1, 6, 6, 4, CHANNELS)
    both = render(head, voxels, cameras_at((0.0, 0.0, 0.0), (0.5, -1.0, 0.2)), torch.zeros(1, 3))
    alone = render(head, voxels, cameras_at((0.5, -1.0, 0.2)), torch.zeros(1, 3))
    torch.testing.assert_close(both[:, 1:], alone, rtol=1e-4, atol=1e-5)
    moved = render(head, voxels, cameras_at((8.5, -5.0, 2.2)), torch.tensor([[8.0, -4.0, 2.0]]))
    torch.testing.assert_close(moved, alone, rtol=1e-3, atol=1e-4)
