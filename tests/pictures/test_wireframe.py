# SPDX-License-Identifier: Apache-2.0
"""Box edges end up where a camera sees them, and never behind it."""

from __future__ import annotations

import pytest
import torch

from raytran.geometry.camera import Cameras
from raytran.pictures.wireframe import NEAR, box_corners, box_segments
from raytran.structs import ObjectSet

# world_from_object with yaw 0: width along x, height along z, front (-Z of the object) along +y.
UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def box(center: tuple[float, float, float], size: tuple[float, float, float]) -> ObjectSet:
    one = torch.ones(1, dtype=torch.int64)
    return ObjectSet(one, torch.tensor([center]), torch.tensor([size]), UPRIGHT[None], one, torch.ones(1))


def camera_at(x: float, y: float, z: float) -> Cameras:
    """A camera that looks along the world's +y, x to the right, 100 pixels of focal length."""
    intrinsics = torch.tensor([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]])
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[:3, 3] = torch.tensor([x, y, z])
    return Cameras(intrinsics, pose, (120, 160))


def test_corners_follow_the_object_frame():
    corners = box_corners(box((1.0, 2.0, 3.0), (0.2, 0.4, 0.6)))[0]
    assert torch.allclose(corners.amin(0), torch.tensor([0.9, 1.7, 2.8]))
    assert torch.allclose(corners.amax(0), torch.tensor([1.1, 2.3, 3.2]))
    # The first corner is low in x, y and z of the object: left, at the bottom, at the front (+y).
    assert torch.allclose(corners[0], torch.tensor([0.9, 2.3, 2.8]))


def test_a_box_before_the_camera():
    # 1 m wide and high, 2 m deep, its near face 4 m away and its far face, the front, 6 m.
    segments = box_segments(box((0.0, 5.0, 0.0), (1.0, 1.0, 2.0)), camera_at(0, 0, 0))[0]
    assert len(segments) == 12
    assert sum(front for *_, front in segments) == 4
    front = torch.tensor([end for *end, is_front in segments if is_front]).reshape(-1, 2)
    assert front[:, 0].min().item() == pytest.approx(80 - 100 * 0.5 / 6)
    assert front[:, 1].max().item() == pytest.approx(60 + 100 * 0.5 / 6)
    every = torch.tensor([end for *end, _ in segments]).reshape(-1, 2)
    assert every[:, 0].max().item() == pytest.approx(80 + 100 * 0.5 / 4)
    assert segments[0][-1], "the farthest edges, here the front's, come first"


def test_edges_are_cut_at_the_near_plane():
    # The camera stands inside: four edges are behind it, four cross the near plane, four lie ahead.
    segments = box_segments(box((0.0, 0.5, 0.0), (1.0, 1.0, 2.0)), camera_at(0, 0, 0))[0]
    assert len(segments) == 8
    every = torch.tensor([end for *end, _ in segments]).reshape(-1, 2)
    # An edge at x = 0.5 leaves the picture to the right; a mirrored one would leave to the left.
    assert every[:, 0].max().item() == pytest.approx(80 + 100 * 0.5 / NEAR)
    cut = [ends for *ends, _ in segments if max(abs(ends[0] - 80), abs(ends[2] - 80)) > 500]
    assert len(cut) == 4
    for u0, v0, u1, v1 in cut:
        assert (u0 - 80) * (u1 - 80) > 0
        assert (v0 - 60) * (v1 - 60) > 0


def test_a_box_behind_the_camera_and_no_box():
    assert box_segments(box((0.0, -5.0, 0.0), (1.0, 1.0, 1.0)), camera_at(0, 0, 0)) == [[]]
    assert box_segments(ObjectSet.empty(), camera_at(0, 0, 0)) == []
