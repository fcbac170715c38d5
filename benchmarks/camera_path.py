# SPDX-License-Identifier: Apache-2.0
"""Cameras to measure with: a made-up walk around a room, or the poses of a recorded scan."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid

FEATURE_SIZE = (30, 40)


def paper_grid(cameras: Cameras) -> VoxelGrid:
    """Return the paper's grid, centred on the cameras."""
    return VoxelGrid((48, 48, 16), (9.0, 9.0, 3.5), cameras.position.mean(dim=-2))


def walk(views: int) -> Cameras:
    """Return a turn around a point, 1.5 m high, looking 25° down and outwards, 58° × 45° field of view."""
    turn = torch.arange(views, dtype=torch.float64) / views * 2 * math.pi
    down = math.radians(25) + 0.1 * torch.sin(3 * turn)
    forward = torch.stack([turn.cos() * down.cos(), turn.sin() * down.cos(), -down.sin()], dim=-1)
    right = torch.stack([turn.sin(), -turn.cos(), torch.zeros_like(turn)], dim=-1)
    pose = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    pose[:, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-1)
    pose[:, :3, 3] = torch.stack(
        [1.2 * (turn + 2).cos(), 0.9 * (turn + 2).sin(), 1.5 + 0.2 * (2 * turn).sin()], -1
    )
    focal = 320 / math.tan(math.radians(29))
    intrinsics = torch.tensor([[focal, 0, 320], [0, focal, 240], [0, 0, 1]], dtype=torch.float64)
    return Cameras(intrinsics.expand(views, 3, 3), pose, (480, 640))


def recorded(scan: Path, views: int) -> Cameras:
    """Return evenly spread cameras of a scan in ScanNet's layout."""
    header = dict(
        line.split(" = ") for line in (scan / f"{scan.name}.txt").read_text().splitlines() if " = " in line
    )
    poses = {int(path.stem): np.loadtxt(path) for path in (scan / "pose").glob("*.txt")}
    frames = sorted(frame for frame, pose in poses.items() if np.isfinite(pose).all())
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, views).round().astype(int)]
    intrinsics = torch.tensor(np.loadtxt(scan / "intrinsic" / "intrinsic_color.txt")[:3, :3])
    size = (int(header["colorHeight"]), int(header["colorWidth"]))
    return Cameras(intrinsics.expand(views, 3, 3), torch.tensor(np.stack([poses[i] for i in chosen])), size)
