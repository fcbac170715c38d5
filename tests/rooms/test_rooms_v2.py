# SPDX-License-Identifier: Apache-2.0
"""rooms-v2: what its splits share and what not, and what its scans hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytran.data.dataset import scan2cad_dataset
from raytran.errors import ConfigError
from raytran.rooms import benchmark, rooms_v2
from raytran.rooms.materials import ROOM_OWNER
from raytran.rooms.rooms_v2 import generate_rooms_v2
from raytran.rooms.scene import make_scene

HOW = {"processes": 1, "progress": False}
SMALL = replace(rooms_v2.SETTINGS, frames=4, image_size=(48, 64), max_objects=8)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two training rooms with small pictures, the second added to the first, and the first one's files."""
    root = tmp_path_factory.mktemp("rooms-v2")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rooms_v2, "SETTINGS", SMALL)
        generate_rooms_v2(root, num_train=1, num_val=0, **HOW)
        first = content(root / "scannet" / "scans")
        return root, first, generate_rooms_v2(root, num_train=2, num_val=0, **HOW)


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def scene():
    """A scene with clutter."""
    return make_scene(SMALL, np.random.default_rng(3), look="world")


def test_rooms_are_added_and_those_there_stay(made):
    root, first, report = made
    assert (report.train, report.made) == (("scene0000_00", "scene0001_00"), 1)
    after = content(root / "scannet" / "scans")
    assert first == {path: data for path, data in after.items() if path.parts[0] == "scene0000_00"}


def test_scans_are_read_as_scan2cads(made, tmp_path):
    dataset = scan2cad_dataset(
        made[0],
        "train",
        cache_dir=tmp_path,
        num_views=2,
        image_size=(48, 64),
        grid_resolution=(8, 8, 4),
        grid_extent=(8.0, 8.0, 3.0),
    )
    assert len(dataset) == 2
    assert all(len(dataset[i].objects[0]) >= 3 for i in range(2))


def test_no_split_meets_another_or_rooms_v1(monkeypatch, tmp_path):
    seen = {}

    def record(output, settings, splits, **rest):
        seen.update({split.name: (settings, split) for split in splits})

    monkeypatch.setattr(rooms_v2, "make_splits", record)
    generate_rooms_v2(tmp_path, num_train=3, num_val=2)
    (settings, train), (_, val) = seen["train"], seen["val"]
    assert (list(train.numbers), list(val.numbers)) == ([0, 1, 2], [8000, 8001])
    assert settings.seed != benchmark.SETTINGS.seed
    of_v1 = {*benchmark._models(1), *benchmark._models(2)}
    assert not {*train.models} & {*val.models}
    assert not ({*train.models} | {*val.models}) & of_v1
    # The other half of given models is what networks are judged on.
    assert {train.given, val.given} == {"train"}
    assert train.textures != val.textures
    with pytest.raises(ConfigError, match="num_train"):
        generate_rooms_v2(tmp_path, num_train=8001)


def test_what_is_strewn_about_is_drawn_and_never_annotated(scene):
    owner = scene.renderer._surfaces.owner
    assert set(np.unique(owner)) == {ROOM_OWNER, *range(len(scene.objects))}
    assert (owner == ROOM_OWNER).sum() > len(scene.room.surfaces.owner)


def test_what_is_stored_of_the_camera_is_what_tracking_found(scene):
    true = np.stack([camera.room_from_camera for camera in scene.cameras])
    assert scene.film is not None
    error = np.linalg.norm((scene.tracked - true)[:, :3, 3], axis=1)
    assert 0 < error.max() < 0.06
    factor = scene.calibrated[0, 0] / scene.cameras[0].intrinsics[0, 0]
    assert 0 < abs(factor - 1) < 0.04
