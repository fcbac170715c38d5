# SPDX-License-Identifier: Apache-2.0
"""Three rooms and settings with which a stage takes seconds."""

from __future__ import annotations

import pytest

from raytran.rooms.generate import generate_rooms


@pytest.fixture(scope="session")
def rooms(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms")
    generate_rooms(
        folder,
        num_train=2,
        num_val=1,
        frames=6,
        image_size=(64, 64),
        min_objects=3,
        max_objects=4,
        room_size=((3.0, 3.5), (3.0, 3.5)),
        processes=1,
        progress=False,
    )
    return folder


@pytest.fixture(scope="session")
def settings(rooms):
    """Overrides for a stage of four steps."""
    return [
        "preset=tiny",
        f"data.root={rooms}",
        "trainer=cpu",
        "views.image_size=[64,64]",
        "views.num_views=3",
        "views.predict_views=4",
        "model.grid_resolution=[8,8,4]",
        "model.heads.objects.num_queries=8",
        "trainer.max_steps=4",
        "trainer.val_check_interval=2",
        "schedule.log_every=1",
        "checkpoint_every=2",
    ]
