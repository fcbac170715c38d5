# SPDX-License-Identifier: Apache-2.0
"""A walk with exact matches of points."""

from __future__ import annotations

import numpy as np
import pytest

from raytran.capture.doctor.matches import Matches


@pytest.fixture(scope="session")
def walk():
    """Poses ``(12, 4, 4)`` that look about while they go, intrinsics, and exact matches of points ahead."""
    rng = np.random.default_rng(0)
    intrinsics = np.array([[300.0, 0, 120], [0, 310, 90], [0, 0, 1]])
    poses = np.tile(np.eye(4), (12, 1, 1))
    for n, pose in enumerate(poses):
        yaw, pitch = 0.25 * n, 0.3 * np.sin(n)
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = [0.3 * n, 0.1 * np.cos(n), 1.4 + 0.05 * n]
    frames, pixels, depths = [], [], []
    for first in range(11):
        depth = rng.uniform(1.5, 4.0, 40)
        pixel = rng.uniform([0, 0], [240, 180], (40, 2))
        rays = np.c_[pixel, np.ones(40)] @ np.linalg.inv(intrinsics).T * depth[:, None]
        world = rays @ poses[first, :3, :3].T + poses[first, :3, 3]
        seen = (world - poses[first + 1, :3, 3]) @ poses[first + 1, :3, :3] @ intrinsics.T
        ahead = seen[:, 2] > 0.2
        frames.append(np.tile([first, first + 1], (ahead.sum(), 1)))
        pixels.append(np.stack([pixel, seen[:, :2] / seen[:, 2:]], axis=1)[ahead])
        depths.append(depth[ahead])
    matches = Matches(np.concatenate(frames), np.concatenate(pixels), tolerance_px=0.5)
    return poses, intrinsics, matches, np.concatenate(depths)
