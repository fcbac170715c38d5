# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from raytran.geometry.camera import pose_from_heading
from raytran.rooms.cameras import CLEARANCE, make_intrinsics
from raytran.rooms.objects import Boxes


def test_intrinsics_have_the_sensors_field_of_view():
    for seed in range(5):
        matrix = make_intrinsics((480, 640), np.random.default_rng(seed))
        assert 2 * np.degrees(np.arctan(320 / matrix[0, 0])) == pytest.approx(58, abs=1)
        assert 2 * np.degrees(np.arctan(240 / matrix[1, 1])) == pytest.approx(45, abs=1)
        assert abs(matrix[0, 2] - 320) < 5


def test_look_gives_an_opencv_camera():
    pose = pose_from_heading(np.array([1.0, 2.0, 1.5]), np.pi / 2, 0.0, 0.0)
    np.testing.assert_allclose(pose[:3, 2], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 0], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 1], [0, 0, -1], atol=1e-12)
    tilted = pose_from_heading(np.zeros(3), 0.4, 0.5, 0.2)
    assert np.linalg.det(tilted[:3, :3]) == pytest.approx(1.0)
    assert tilted[2, 2] == pytest.approx(-np.sin(0.5))


def test_cameras_are_in_the_room_and_outside_furniture(scenes):
    for scene in scenes:
        eyes = np.stack([camera.room_from_camera[:3, 3] for camera in scene.cameras])
        assert (eyes[:, 2] >= 1.2).all()
        assert (eyes[:, 2] <= 1.8).all()
        assert ((eyes[:, :2] > 0.25) & (eyes[:, :2] < np.array(scene.room.size[:2]) - 0.25)).all()
        boxes = Boxes.joined([placed.box for placed in scene.objects])
        assert not boxes.grown(CLEARANCE / 2).contain(eyes).any()


def test_cameras_look_down_by_about_25_degrees(scenes):
    down = [np.degrees(np.arcsin(-c.room_from_camera[2, 2])) for scene in scenes for c in scene.cameras]
    assert np.mean(down) == pytest.approx(25, abs=2)
    assert 10 < min(down) < max(down) < 40


def test_every_object_is_seen_in_three_frames(scenes):
    """Counted on all pixels, not on the coarse pictures that the path was planned with."""
    for scene in scenes:
        times = np.zeros(len(scene.objects), dtype=int)
        for camera in scene.cameras:
            owner = scene.renderer.owners(camera, 1)
            times += np.bincount(owner[owner >= 0], minlength=len(times)) > 0
        assert times.min() >= 3, [placed.model.kind for placed in scene.objects]


def test_the_camera_moves_and_sees_furniture(scenes):
    for scene in scenes:
        eyes = np.stack([camera.room_from_camera[:3, 3] for camera in scene.cameras])
        assert np.ptp(eyes, axis=0)[:2].max() > 0.3
        share = [(scene.renderer.owners(camera, 2) >= 0).mean() for camera in scene.cameras]
        assert np.mean(share) > 0.08
