# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import pytest
import torch
import trimesh

from raytran.classes import PAPER_CLASSES, SCAN2CAD_CLASS_BY_CATID
from raytran.data.scan2cad import read_annotations, scene_objects
from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.rooms.statistics import listed_scans, look, rooms_statistics
from raytran.structs import ObjectSet

B = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture
def shapenet(tmp_path):
    """Return a folder that holds one model, a box."""
    folder = tmp_path / "03001627" / "box" / "models"
    folder.mkdir(parents=True)
    trimesh.creation.box().export(folder / "model_normalized.obj")
    return tmp_path


def boxes(*places):
    """Return cubes of 1 m at the given distances along +y."""
    count = len(places)
    return ObjectSet(
        label=torch.full((count,), 3),
        center=torch.tensor([[x, y, 0.0] for x, y in places]),
        size=torch.ones(count, 3),
        rotation=B.expand(count, 3, 3),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
        model_id=("03001627/box",) * count,
    )


def cameras(count=1):
    """Return cameras at the origin that look along +y."""
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    intrinsics = torch.tensor([[96.0, 0.0, 96.0], [0.0, 96.0, 96.0], [0.0, 0.0, 1.0]])
    return Cameras(intrinsics.expand(count, 3, 3), pose.expand(count, 4, 4), (192, 192))


def test_what_stands_behind_another_is_hidden(shapenet):
    sight = look(boxes((0, 3), (0, 6), (4, 6)), cameras(2), shapenet_root=shapenet)
    # In pictures of 48 × 48 pixels with f = 24 the fronts, 2.5 and 5.5 m away, are 9.6 and 4.4 pixels wide.
    assert sight.outline.tolist() == sight.outline[:, :1].expand(3, 2).tolist()
    assert 81 <= sight.outline[0, 0] <= 121
    assert 16 <= sight.outline[1, 0] <= 25
    assert sight.visible[:, 0].tolist() == [sight.outline[0, 0], 0, sight.outline[2, 0]]
    assert sight.shown.tolist() == [[True, True], [False, False], [True, True]]


def test_numbers_are_those_of_the_annotation(room):
    (entry,) = json.loads((room / "scan2cad" / "full_annotations.json").read_text())
    models, count = entry["aligned_models"], entry["n_aligned_models"]
    statistics = rooms_statistics(room)
    part = statistics["train"]
    assert list(statistics) == ["train"]
    assert (part["rooms"], part["objects"], part["frames_per_room"]) == (1, count, {20: 1})
    assert part["cad_models"] == len({model["id_cad"] for model in models})
    assert part["objects_per_room"] == dict.fromkeys(part["objects_per_room"], count)
    assert part["rooms_with_at_most"] == {"10": 1, "20": 1, "30": 1}
    assert sum(of["objects"] for of in part["by_class"].values()) == count
    for catid, name in SCAN2CAD_CLASS_BY_CATID.items():
        assert part["by_class"][name]["objects"] == sum(model["catid_cad"] == catid for model in models)
    # The walk was planned to see every object three times at least; a frame that sees a corner counts there.
    assert 1 <= part["sight"]["frames_per_object"]["min"] <= part["sight"]["frames_per_object"]["max"] <= 20
    assert 1 < part["sight"]["objects_per_frame"] <= count
    assert 0.5 < part["sight"]["visible_share"] <= 1


def test_sizes_are_medians_of_each_class(room):
    (annotation,) = read_annotations(room / "scan2cad" / "full_annotations.json").values()
    objects = scene_objects(annotation)
    by_class = rooms_statistics(room)["train"]["by_class"]
    for index, name in enumerate(PAPER_CLASSES.names):
        sizes = objects.size[objects.label == index]
        expected = [round(side, 2) for side in sizes.median(dim=0).values.tolist()] if len(sizes) else None
        assert by_class[name]["size_m"] == expected


def test_splits_without_scans_are_left_out(room, tmp_path):
    assert {name: len(scans) for name, scans in listed_scans(room).items()} == {"train": 1}
    assert listed_scans(tmp_path) == {}
    with pytest.raises(DataError, match=r"cannot read .*full_annotations.json"):
        rooms_statistics(tmp_path)
