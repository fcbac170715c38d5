# SPDX-License-Identifier: Apache-2.0
"""Images that were stored sideways show the same points of the world after they are turned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.capture.colmap import read_colmap
from raytran.capture.imported import from_files
from raytran.capture.turned import turned_upright
from raytran.geometry.camera import Cameras

from .forms import write_colmap

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def scan(walk):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    return from_files(read_colmap(walk.folder))


def rolled(scan, quarters):
    """The same scan by somebody who held the camera turned by quarters, clockwise seen from behind."""
    poses = scan.world_from_camera.clone()
    angle = torch.tensor(quarters * torch.pi / 2, dtype=torch.float64)
    roll = torch.eye(3, dtype=torch.float64)
    roll[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    poses[:, :3, :3] = poses[:, :3, :3] @ roll
    return replace(scan, world_from_camera=poses)


def test_an_upright_scan_is_left_alone(scan):
    assert turned_upright(scan, UP) is scan


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_images_and_cameras_are_turned_together(scan, quarters):
    sideways = rolled(scan, quarters)
    upright = turned_upright(sideways, UP)
    assert upright.image_size == ((64, 48) if quarters % 2 else (48, 64))
    tops = -upright.world_from_camera[:, 2, 1]
    assert float(tops.min()) > 0.9
    # A pixel of the stored image is found where its point of the world is seen in the turned one.
    images = [np.zeros((48, 64, 3), np.uint8) for _ in range(12)]
    pixel = (13, 50)
    images[4][pixel] = 255
    object.__setattr__(sideways, "pictures", type("", (), {"read": lambda self, i, *_: images[i]})())
    row, column = (int(value[0]) for value in np.nonzero(upright.read_color(4)[..., 0]))
    ray = torch.tensor([pixel[1] + 0.5, pixel[0] + 0.5, 1.0], dtype=torch.float64)
    pose = sideways.world_from_camera[4]
    point = pose[:3, :3] @ torch.linalg.inv(sideways.intrinsics) @ (2 * ray) + pose[:3, 3]
    cameras = Cameras(upright.intrinsics, upright.world_from_camera[4], upright.image_size)
    seen, depth = cameras.project(point[None])
    assert seen[0].tolist() == pytest.approx([column + 0.5, row + 0.5])
    assert depth.item() == pytest.approx(2.0)


def test_sizes_are_those_of_the_turned_image(scan):
    upright = turned_upright(rolled(scan, 1), UP)
    assert upright.read_color(3).shape == (64, 48, 3)
    assert upright.read_color(3, (32, 20)).shape == (32, 20, 3)
    assert upright.color_bytes(3) is None
    assert upright.path == scan.path


def test_images_that_turn_in_all_ways_are_left_alone(scan):
    poses = torch.cat([rolled(scan, q).world_from_camera[q::4] for q in range(4)])
    mixed = replace(scan, world_from_camera=poses)
    assert turned_upright(mixed, UP) is mixed
