# SPDX-License-Identifier: Apache-2.0
"""Cameras for plans and benchmarks: a synthetic walk around a room, or the poses of a scan."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from raytran.data.scannet.scan import read_scan
from raytran.data.views import choose_even
from raytran.geometry.camera import Cameras


def walk(views: int) -> Cameras:
    """Return a turn around a point, 1.5 m high, looking 25° down and outwards, 58° × 45° field of view.

    Args:
        views: N.

    Returns:
        float64 cameras of leading shape ``(N,)``, for images of 640×480.
    """
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
    """Return evenly spread cameras of a scan in ScanNet's layout, float64, leading shape ``(N,)``.

    Raises:
        DataError: the folder or a part of it is missing, or no pose is valid.
    """
    found = read_scan(scan)
    chosen = choose_even(len(found), views)
    return found.cameras[chosen]
