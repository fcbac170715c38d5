# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import torch

from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.rooms.layout import MAX_TILT, Layout
from raytran.rooms.library import ModelPool
from raytran.rooms.objects import FLOOR, upright_rotation, yaw_facing
from raytran.rooms.room import make_room


@pytest.fixture
def layout():
    return Layout(
        room=make_room("office", (5.0, 4.0, 2.6), np.random.default_rng(1)), rng=np.random.default_rng(2)
    )


def draw(category, *kinds):
    return ModelPool(0).draw(category, np.random.default_rng(3), kinds=kinds)


def as_boxes(objects):
    parts = [(placed.box.center[0], 2 * placed.box.half[0], placed.rotation) for placed in objects]
    return OrientedBoxes(*(torch.from_numpy(np.stack(column)) for column in zip(*parts, strict=True)))


def test_floor_object_stands_on_the_floor_with_its_box_where_asked(layout):
    number = layout.on_floor(draw("chair"), np.array([2.5, 2.0]), 0.7)
    placed = layout.objects[number]
    np.testing.assert_allclose(placed.box.center[0, :2], [2.5, 2.0], atol=1e-9)
    assert placed.box.corners()[0, :, 2].min() == pytest.approx(0.001, abs=1e-9)
    sizes = 2 * placed.box.half[0]
    np.testing.assert_allclose(sizes, placed.model.size_m, rtol=0.0501)


def test_tilts_are_between_zero_and_four_degrees(scenes):
    up = np.concatenate([[placed.rotation[2, 1] for placed in scene.objects] for scene in scenes])
    tilt = np.degrees(np.arccos(np.clip(up, -1, 1)))
    assert tilt.max() <= np.degrees(MAX_TILT) + 1e-6
    assert np.median(tilt) > 0.5


def test_an_occupied_place_is_refused(layout):
    assert layout.on_floor(draw("chair"), np.array([2.5, 2.0]), 0.0) is not None
    assert layout.on_floor(draw("trashbin"), np.array([2.5, 2.0]), 0.0) is None
    assert layout.on_floor(draw("trashbin"), np.array([0.0, 2.0]), 0.0) is None
    assert len(layout.objects) == 1


def test_wall_object_has_its_back_to_the_wall(layout):
    for wall, inward in enumerate(([0, 1], [-1, 0], [0, -1], [1, 0])):
        number = layout.at_wall(draw("bookshelf"), wall=wall)
        if number is not None:
            front = -layout.objects[number].rotation[:2, 2]
            assert front @ np.array(inward) > 0.95
            corners = layout.objects[number].box.corners()[0, :, :2]
            distance = (corners - layout.room.walls[wall].origin) @ np.array(inward)
            assert 0.0 < distance.min() < 0.3
    assert layout.objects


def test_display_stands_on_the_tilted_desk_top(layout):
    desk = layout.on_floor(draw("table", "desk"), np.array([2.5, 2.0]), 0.3)
    number = layout.on_top(desk, draw("display", "monitor"), place=(0.0, 0.3), turn=0.0)
    below, above = layout.objects[desk], layout.objects[number]
    assert above.parent == desk
    np.testing.assert_allclose(above.rotation, below.rotation, atol=1e-9)
    up = below.rotation[:, 1]
    foot = (above.box.center[0] - below.box.center[0]) @ up - above.box.half[0, 1]
    assert foot == pytest.approx(below.box.half[0, 1] + 0.002, abs=0.003)


def test_nothing_interpenetrates(scenes):
    for scene in scenes:
        _, shared = box_iou(as_boxes(scene.objects), as_boxes(scene.objects))
        for i, a in enumerate(scene.objects):
            for j, b in enumerate(scene.objects[:i]):
                if j != a.parent and i != b.parent:
                    assert float(shared[i, j]) < 1e-9, (a.model.kind, b.model.kind)


def test_what_stands_on_others_does_not_reach_into_them(scenes):
    """No vertex of the upper object is more than 1 cm below the surface, except on upholstery."""
    count = 0
    for scene in scenes:
        for placed in scene.objects:
            if placed.parent == FLOOR:
                continue
            count += 1
            base = scene.objects[placed.parent]
            up = base.rotation[:, 1]
            points, below = placed.triangles().reshape(-1, 3) @ up, base.triangles().reshape(-1, 3) @ up
            soft = base.model.kind == "bed" or base.model.category == "sofa"
            if not soft:
                assert points.min() > below.max() - 0.011
            assert points.min() > below.min() + 0.15
    assert count > 5


def test_everything_is_inside_the_room(scenes):
    for scene in scenes:
        for placed in scene.objects:
            corners = placed.triangles().reshape(-1, 3)
            assert corners.min() > -1e-9
            assert (corners < np.array(scene.room.size)).all()


def test_door_is_free(scenes):
    for scene in scenes:
        door = scene.room.openings[0]
        lower, upper = scene.room.walls[door.wall].box(door.s, (0.0, 0.8), door.z)
        for placed in scene.objects:
            points = placed.triangles().reshape(-1, 3)
            assert not ((points > lower) & (points < upper)).all(axis=1).any()


def test_yaw_facing_turns_the_front():
    for angle in np.linspace(-3, 3, 7):
        direction = np.array([np.cos(angle), np.sin(angle)])
        front = upright_rotation(yaw_facing(direction)) @ np.array([0.0, 0.0, -1.0])
        np.testing.assert_allclose(front, [*direction, 0.0], atol=1e-12)
