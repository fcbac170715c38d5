# SPDX-License-Identifier: Apache-2.0
"""Metres from the height of the phone, or from a distance between marked points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytran.capture.poses.floor import Floor
from raytran.capture.poses.mapping import FoundCameras
from raytran.capture.poses.unit import unit_by_distance, unit_by_height
from raytran.errors import ConfigError, DataError
from raytran.geometry.camera import pose_from_heading

ENDS = np.array([[4.0, -0.5, 0.3], [4.1, 0.4, 2.3]])
"""Of a door, metres."""

UNIT = 0.25
"""Metres in a unit of the model."""


@pytest.fixture
def found():
    """Three cameras that see the door, in units of the model."""
    eyes = ([0, 0, 1.5], [0.2, 0.9, 1.4], [-0.3, -0.8, 1.5])
    poses = np.array([pose_from_heading(np.array(eye, dtype=float), -eye[1] / 3, 0.1, 0.0) for eye in eyes])
    poses[:, :3, 3] /= UNIT
    names = ("000012.jpg", "000040.jpg", "IMG_7.jpg")
    return FoundCameras(names, poses, (480, 640), 420.0, (320.0, 240.0), 0.0, np.zeros((0, 3)), 3, 1, 0.5)


def seen(found, frame):
    """Return the pixels (u1, v1, u2, v2) at which a frame sees the ends, by a lens without distortion."""
    pose = found.world_from_camera[frame]
    points = (ENDS / UNIT - pose[:3, 3]) @ pose[:3, :3]
    pixels = points[:, :2] / points[:, 2:] * found.focal + found.center
    return pixels.ravel().tolist()


def test_the_height_of_the_phone():
    cameras = np.array([[0, 0, 7.0], [1, 0, 5.0]])
    assert unit_by_height(Floor(2.0, 50), cameras, 1.5) == pytest.approx(1.5 / 4)
    with pytest.raises(DataError, match=r"no floor is found .*distance= and marks="):
        unit_by_height(None, cameras, 1.5)


@pytest.mark.parametrize("frames", [(0, 1), (0, 2), (0, 1, 2)])
def test_a_distance_between_marks(found, frames):
    names = (12, 40, "IMG_7")
    marks = [[names[frame], *seen(found, frame)] for frame in frames]
    length = float(np.linalg.norm(ENDS[0] - ENDS[1]))
    assert unit_by_distance(found, length, marks) == pytest.approx(UNIT, rel=1e-9)


def test_marks_by_hand_are_pixels_off(found):
    rng = np.random.default_rng(0)
    marks = [
        [name, *(np.array(seen(found, i)) + rng.uniform(-1.5, 1.5, 4))]
        for i, name in enumerate((12, 40, "IMG_7"))
    ]
    length = float(np.linalg.norm(ENDS[0] - ENDS[1]))
    assert unit_by_distance(found, length, marks) == pytest.approx(UNIT, rel=0.01)


def test_distortion_is_taken_out(found):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap, which knows lenses, is not installed")
    bent = replace(found, distortion=0.08)
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=640, height=480, params=[420, 320, 240, 0.08])
    marks = []
    for frame, name in ((0, 12), (1, 40)):
        straight = (np.array(seen(found, frame)).reshape(2, 2) - found.center) / found.focal
        pixels = np.asarray(camera.img_from_cam(np.column_stack([straight, np.ones(2)])))
        marks.append([name, *pixels.ravel().tolist()])
    length = float(np.linalg.norm(ENDS[0] - ENDS[1]))
    assert unit_by_distance(bent, length, marks) == pytest.approx(UNIT, rel=1e-6)
    assert unit_by_distance(found, length, marks) != pytest.approx(UNIT, rel=1e-3)


def test_marks_that_make_no_sense(found):
    off = np.add(seen(found, 1), (0, 60, 0, 0))
    good = [[12, *seen(found, 0)], [40, *seen(found, 1)]]
    for marks, message in [
        (good[:1], "mark both points in two frames or more"),
        ([good[0], good[0]], "mark both points in two frames or more"),
        ([good[0], [13, *seen(found, 1)]], "frame 13, which has no pose: .*e.g. 000012"),
        ([good[0], [40, 1, 2, 3]], "is no frame,u1,v1,u2,v2"),
        ([good[0], 7], "is no frame,u1,v1,u2,v2"),
        ([good[0], [40, 1, 2, 3, 700]], "outside of its 640x480"),
        ([good[0], [40, *off]], "first point do not fit each other"),
    ]:
        with pytest.raises((ConfigError, DataError), match=message):
            unit_by_distance(found, 2.0, marks)
    near = replace(found, world_from_camera=found.world_from_camera[[0, 0, 0]])
    with pytest.raises(ConfigError, match=r"directions only 0\.0° apart"):
        unit_by_distance(near, 2.0, [[12, *seen(near, 0)], [40, *seen(near, 1)]])
