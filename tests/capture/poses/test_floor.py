# SPDX-License-Identifier: Apache-2.0
"""The floor of a room of points, its height and normal: with furniture, stray points, tilted cameras."""

from __future__ import annotations

import numpy as np
import pytest

from raytran.capture.orientation import rotation_to_z
from raytran.capture.poses.floor import find_floor, level_by_floor

CAMERAS = np.array([[x, y, 1.5 + 0.1 * np.sin(x)] for x in range(4) for y in range(3)], dtype=float)


def points_of_a_room(rng, *, floor=True, strays=20):
    """Points of walls, a table of 0.75 m, a seat of 0.45 m, the floor and what was matched wrongly."""
    walls = rng.uniform((0, 0, 0.1), (4, 3, 2.4), (800, 3))
    walls[:, 0] = np.where(rng.random(800) < 0.5, 0, 4)
    table = rng.uniform((1, 1, 0.74), (2, 2, 0.76), (200, 3))
    seat = rng.uniform((3, 1, 0.44), (3.4, 1.4, 0.46), (150, 3))
    parts = [walls, table, seat, rng.uniform((-2, -2, -2), (6, 5, 3), (strays, 3))]
    if floor:
        parts.append(
            rng.normal(0, 0.008, (150, 3))
            + np.column_stack([rng.uniform(0, 4, 150), rng.uniform(0, 3, 150), np.zeros(150)])
        )
    return np.concatenate(parts)


@pytest.mark.parametrize("unit", [1.0, 0.01, 30.0])
@pytest.mark.parametrize("height", [0.0, -3.0])
def test_the_floor_is_found_in_any_unit(unit, height):
    shift = np.array([0, 0, height])
    points = points_of_a_room(np.random.default_rng(0)) + shift
    floor = find_floor(points * unit, (CAMERAS + shift) * unit)
    assert floor.height / unit == pytest.approx(height, abs=0.015)
    assert 100 < floor.num_points < 260


def test_walls_that_thin_out_are_no_floor():
    """Cameras that look too little down see less and less of the walls, but furniture."""
    rng = np.random.default_rng(0)
    points = points_of_a_room(rng, floor=False, strays=0)
    seen = points[rng.random(len(points)) < points[:, 2] - 0.3]
    assert find_floor(seen, CAMERAS) is None
    assert find_floor(points[:10], CAMERAS) is None


@pytest.mark.parametrize("tilt_deg", [1.0, 2.0, 3.5])
def test_up_is_the_normal_of_the_floor(tilt_deg):
    points = points_of_a_room(np.random.default_rng(1))
    angle = np.radians(tilt_deg)
    up = np.array([np.sin(angle) * 0.8, np.sin(angle) * 0.6, np.cos(angle)])
    level = level_by_floor(up, points, CAMERAS)
    assert np.degrees(np.arccos(level[2])) < 0.4
    # In any world.
    turn = rotation_to_z(np.array([0.6, 0.0, 0.8]))
    turned = level_by_floor(turn @ up, points @ turn.T, CAMERAS @ turn.T)
    np.testing.assert_allclose(turned, turn @ level, atol=2e-3)


def test_without_a_floor_up_is_that_of_the_cameras():
    up = np.array([0.0, 0.1, 0.995]) / np.linalg.norm([0.0, 0.1, 0.995])
    assert level_by_floor(up, np.zeros((3, 3)), CAMERAS) is up
