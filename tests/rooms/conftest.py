# SPDX-License-Identifier: Apache-2.0
"""A few furnished rooms, made once for all tests of this folder."""

from __future__ import annotations

import json

import numpy as np
import pytest

from raytran.rooms.cad import RECIPES, sample_model
from raytran.rooms.scene import RoomSettings, make_scene
from raytran.rooms.shapenet_files import write_model


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


@pytest.fixture(scope="session")
def cads(tmp_path_factory):
    """Return models of every class, half of each for either split, that no pool generates."""
    root = tmp_path_factory.mktemp("cads")
    for category in RECIPES:
        for seed in range(4):
            model = sample_model(category, np.random.default_rng([9, seed]))
            path = write_model(model, root) / "model_normalized.json"
            split = ("train", "val")[seed % 2]
            path.write_text(json.dumps(json.loads(path.read_text()) | {"unit": "m", "split": split}))
    (root / "credits.csv").write_text("model,creator\n")
    return root
