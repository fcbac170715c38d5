# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest

from raytran.classes import PAPER_CLASSES
from raytran.rooms.furnish import Furnisher
from raytran.rooms.layout import Layout
from raytran.rooms.library import ModelPool
from raytran.rooms.objects import FLOOR
from raytran.rooms.room import make_room


@cache
def furnished(kind, seed, wanted=12):
    rng = np.random.default_rng(seed)
    layout = Layout(room=make_room(kind, (5.5, 4.5, 2.6), rng), rng=rng)
    Furnisher(layout=layout, pool=ModelPool(0), wanted=wanted).furnish()
    return layout.objects


@pytest.mark.parametrize("kind", ["office", "living", "bedroom", "dining", "meeting", "bathroom"])
def test_number_of_objects_is_kept(kind):
    for seed in range(2):
        assert 3 <= len(furnished(kind, seed, wanted=6)) <= 6


def test_rooms_hold_what_they_are_named_for():
    typical = {
        "office": "desk",
        "living": "sofa",
        "bedroom": "bed",
        "dining": "dining table",
        "bathroom": "bathtub",
    }
    for kind, piece in typical.items():
        names = [placed.model.kind for seed in range(2) for placed in furnished(kind, seed)]
        names += [placed.model.category for seed in range(2) for placed in furnished(kind, seed)]
        assert piece in names


def test_chairs_face_the_table_and_stand_at_it():
    facing = []
    for seed in range(6):
        objects = furnished("dining", seed)
        tables = [placed for placed in objects if placed.model.kind == "dining table"]
        for chair in (placed for placed in objects if placed.model.category == "chair"):
            for table in tables:
                way = table.box.center[0, :2] - chair.box.center[0, :2]
                if np.linalg.norm(way) < 1.0:
                    front = -chair.rotation[:2, 2]
                    facing.append(front @ way / np.linalg.norm(way))
    assert len(facing) > 8
    assert np.median(facing) > 0.85


def test_displays_stand_on_furniture_and_look_the_way_of_the_desk():
    seen = 0
    for seed in range(6):
        objects = furnished("office", seed)
        for placed in objects:
            if placed.model.category == "display":
                assert placed.parent != FLOOR
                base = objects[placed.parent]
                if base.model.kind == "desk":
                    seen += 1
                    assert placed.rotation[:, 2] @ base.rotation[:, 2] > 0.7
    assert seen >= 4


def test_all_classes_occur():
    kinds = ["office", "living", "bedroom", "dining", "meeting", "bathroom"]
    counts = Counter(p.model.category for kind in kinds for seed in range(2) for p in furnished(kind, seed))
    assert set(counts) == set(PAPER_CLASSES.names)
