# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from raytran.rooms.render import Renderer
from raytran.rooms.room import make_room

SIZE = (5.0, 4.0, 2.6)


@pytest.fixture(params=range(4))
def room(request):
    return make_room("office", SIZE, np.random.default_rng(request.param))


def test_walls_enclose_the_floor(room):
    for wall in room.walls:
        end = wall.point(wall.length, 0.0)
        assert ((end[:2] >= -1e-9) & (end[:2] <= np.array(SIZE[:2]) + 1e-9)).all()
        into = wall.point(wall.length / 2, 1.0)[:2]
        assert ((into > 0.5) & (into < np.array(SIZE[:2]) - 0.5)).all()


def test_openings_lie_in_their_walls_and_apart(room):
    assert [opening.kind for opening in room.openings].count("door") == 1
    assert {opening.kind for opening in room.openings} == {"door", "window"}
    assert len({opening.wall for opening in room.openings}) == len(room.openings)
    for opening in room.openings:
        assert 0 < opening.s[0] < opening.s[1] < room.walls[opening.wall].length
        assert 0 <= opening.z[0] < opening.z[1] < SIZE[2]


def test_the_room_is_closed(room):
    """Every ray from inside hits something no farther than the walls."""
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(2000, 3)).astype(np.float32)
    renderer = Renderer(surfaces=room.surfaces, lights=room.lights)
    assert (renderer.first_hit(np.array(SIZE) / 2, rays) >= 0).all()
    corners = room.surfaces.triangles.reshape(-1, 3)
    assert (corners >= -1e-6).all()
    assert (corners <= np.array(SIZE) + 1e-6).all()


def test_lamp_hangs_below_the_ceiling_and_windows_shine_inwards(room):
    lamp, *daylight = room.lights
    assert lamp.shadows
    assert 0 < SIZE[2] - lamp.position[2] < 0.2
    middle = np.array([SIZE[0] / 2, SIZE[1] / 2])
    for light in daylight:
        assert (middle - light.position[:2]) @ light.direction[:2] > 0
