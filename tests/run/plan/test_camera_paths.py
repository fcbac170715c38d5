# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from raytran.geometry.grid import VoxelGrid
from raytran.ops.traverse import trace_pairs
from raytran.run.plan.camera_paths import recorded, walk


def test_the_walk_is_of_rigid_cameras_inside_their_volume() -> None:
    cameras = walk(20)
    rotation = cameras.world_from_camera[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(20).double())
    assert (rotation[:, 2, 2] < 0).all()  # they look down
    assert (rotation[:, 2, 1] < -0.5).all()  # the image's y axis points down


def test_the_walk_meets_about_as_many_voxels_as_the_papers_videos_do() -> None:
    cameras = walk(20)
    grid = VoxelGrid((48, 48, 16), (9.0, 9.0, 3.5), cameras.position.mean(dim=0))
    assert 0.9e6 < len(trace_pairs(cameras, grid, (30, 40))) < 1.2e6  # 64.4 MB a value array: 1.05 M


def test_recorded_cameras_are_evenly_spread(tmp_path: Path) -> None:
    for name in ("color", "pose", "intrinsic"):
        (tmp_path / name).mkdir()
    for n in range(9):
        Image.new("RGB", (64, 48)).save(tmp_path / "color" / f"{n}.jpg")
        pose = np.eye(4)
        pose[0, 3] = n
        np.savetxt(tmp_path / "pose" / f"{n}.txt", pose)
    intrinsic = [[60, 0, 32, 0], [0, 60, 24, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_color.txt", intrinsic)
    cameras = recorded(tmp_path, 3)
    assert cameras.position[:, 0].tolist() == [1.0, 4.0, 7.0]
    assert cameras.image_size == (48, 64)
    assert cameras.intrinsics.shape == (3, 3, 3)
