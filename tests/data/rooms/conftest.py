# SPDX-License-Identifier: Apache-2.0
"""A few furnished rooms, made once for all tests of this folder."""

from __future__ import annotations

import numpy as np
import pytest

from raytran.data.rooms.scene import RoomSettings, make_scene


@pytest.fixture(scope="session")
def settings():
    return RoomSettings(
        seed=5,
        frames=12,
        image_size=(60, 80),
        min_objects=3,
        max_objects=30,
        room_size=((3.0, 7.0), (3.0, 6.0)),
    )


@pytest.fixture(scope="session")
def scenes(settings):
    return [make_scene(settings, np.random.default_rng([settings.seed, number])) for number in range(6)]
