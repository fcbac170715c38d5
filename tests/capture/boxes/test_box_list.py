# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
import trimesh

from raytran.capture.boxes.box_list import boxed_objects, read_box_list
from raytran.capture.boxes.categories import Categories
from raytran.classes import PAPER_CLASSES, Classes
from raytran.errors import ConfigError, DataError
from raytran.export.write import write_scene_json
from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import ScenePrediction

CHAIR = {"category": "chair", "center": [1.0, 2.0, 0.5], "size": [0.5, 0.9, 0.6], "yaw": 0.3}
TURN = torch.tensor([[0.0, 0, 2, 1], [2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
"""x → y → z → x, twice as large, and shifted."""


def read(tmp_path, content, categories=None, **options):
    path = tmp_path / "boxes.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    options = {"world_from_input": None, "scan_mesh": None} | options
    return boxed_objects(read_box_list(path), categories or Categories(PAPER_CLASSES), **options)


def test_a_list_is_read(tmp_path):
    objects = read(tmp_path, [CHAIR, {**CHAIR, "category": "Trashbin", "symmetry": 0, "yaw": -1}])
    assert objects.category == ("chair", "trashbin")
    assert objects.symmetry == (1, 0)
    assert objects.center[0].tolist() == [1, 2, 0.5]
    wanted = rotation_from_yaw(torch.tensor([0.3, -1.0], dtype=torch.float64)).numpy()
    np.testing.assert_allclose(objects.rotation, wanted)


def test_boxes_without_a_turn_are_parallel_to_the_axes(tmp_path):
    objects = read(tmp_path, [{key: CHAIR[key] for key in ("category", "center", "size")}])
    np.testing.assert_allclose(objects.rotation[0], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)


def test_what_predict_writes_is_read_as_it_is(tmp_path, make_objects):
    objects = make_objects(4)
    prediction = ScenePrediction("room", objects, torch.zeros(3))
    write_scene_json(tmp_path / "boxes.json", prediction, [None] * 4)
    text = (tmp_path / "boxes.json").read_text()
    # It is in the world that the scan's reader makes, whatever that of the poses is.
    for found in (read(tmp_path, text), read(tmp_path, text, world_from_input=TURN)):
        # Centres are written in tenths of a millimetre.
        np.testing.assert_allclose(found.center, objects.center, atol=6e-5)
        np.testing.assert_allclose(found.rotation, objects.rotation, atol=1e-5)
        assert found.category == objects.category
        assert not found.own_meshes_first


def test_boxes_go_with_the_world_of_the_poses(tmp_path):
    mesh = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    moved = read(tmp_path, [CHAIR], world_from_input=TURN, scan_mesh=mesh)
    np.testing.assert_allclose(moved.center, [[2.0, 2.0, 4.0]])
    np.testing.assert_allclose(moved.size, [[1.0, 1.8, 1.2]])
    np.testing.assert_allclose(moved.rotation[0].T @ moved.rotation[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(moved.scan_mesh[0], [[1, 0, 0], [1, 2, 0], [1, 0, 2]])
    upright = read(tmp_path, {"up": "+z", "objects": [CHAIR]}, world_from_input=TURN, scan_mesh=mesh)
    np.testing.assert_allclose(upright.center, [[1.0, 2.0, 0.5]])
    np.testing.assert_allclose(upright.scan_mesh[0], moved.scan_mesh[0])


def test_own_meshes_are_read_and_missing_ones_named(tmp_path):
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "a.ply")
    objects = read(tmp_path, [{**CHAIR, "mesh": "a.ply"}, {**CHAIR, "mesh": "b.ply"}, CHAIR])
    assert [mesh is not None for mesh in objects.mesh] == [True, False, False]
    assert objects.noticed == {"meshes_missing": ["b.ply"]}
    with pytest.raises(DataError, match=r"outside"):
        read(tmp_path, [{**CHAIR, "mesh": "../a.ply"}])


def test_categories_have_other_names_and_are_left_out(tmp_path):
    categories = Categories(PAPER_CLASSES, {"couch": "sofa", "lamp": None})
    entries = [{**CHAIR, "category": name} for name in ("Couch", "lamp", "03001627")]
    objects = read(tmp_path, entries, categories)
    assert objects.category == ("sofa", "chair")
    assert objects.noticed == {"categories_left_out": ["lamp"]}
    with pytest.raises(ConfigError, match=r"categories\.couch=settee names no class"):
        Categories(PAPER_CLASSES, {"couch": "settee"})


def test_words_of_a_category_are_parted_in_any_way():
    categories = Categories(Classes(("tv_monitor", "shower curtain")))
    assert categories.class_of("TV monitor", "x") == "tv_monitor"
    assert categories.class_of("shower-curtain", "x") == "shower curtain"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (
            [{**CHAIR, "category": "drill"}],
            "object 0 in .* is of category 'drill', which is no class: choose",
        ),
        ([{**CHAIR, "category": 3}], "of category 3, which is no class"),
        ([{**CHAIR, "size": [0.5, 0, 0.6]}], "object 0 in .* has a side of 0 m: give positive full lengths"),
        ([CHAIR, {**CHAIR, "size": [0.5, -1, 0.6]}], "object 1 in .* has a side of -1 m"),
        ([], "lists no box: annotate the objects"),
        ({"objects": []}, "lists no box"),
        ([{"category": "chair", "size": [1, 1, 1]}], "object 0 in .* has no center: give three numbers"),
        ([{**CHAIR, "center": [1, 2]}], "center of object 0 .* does not hold 3 numbers"),
        ([{**CHAIR, "center": [1, 2, math.nan]}], "center of object 0 .* holds nan"),
        ([{**CHAIR, "symmetry": 3}], "symmetry of object 0 .* is 3: give 1, 2 or 4 equal turns, or 0"),
        ([{**CHAIR, "rotation": np.eye(3).tolist()}], "yaw and rotation of object 0 .* differ: correct both"),
        ([{**CHAIR, "yaw": None, "rotation": (2 * np.eye(3)).tolist()}], "rotation of object 0 .* is none"),
        ([{**CHAIR, "yaw": "left"}], "yaw of object 0 .* is 'left'"),
        ({"boxes": [CHAIR]}, "has no list of objects: write"),
        ("[1]", "has no list of objects"),
        ("[", "is no valid JSON"),
        ({"objects": [CHAIR], "unit": "mm"}, "has its boxes in 'mm': write them in metres"),
        ({"objects": [CHAIR], "up": "-y"}, "has up '-y': leave it out"),
        ({"objects": [CHAIR], "split": "training"}, "has split 'training': choose one of train, val, test"),
        ({"objects": [CHAIR], "mesh": 1}, "has mesh 1: give the name"),
        ({"objects": [CHAIR], "capture": {"fps": 3}}, "give some of format, intrinsics, up, scale"),
        ({"objects": [CHAIR], "format": "raytran.scene/9"}, "has format 'raytran.scene/9'"),
        ({"objects": [CHAIR], "spilt": "val"}, "has the key 'spilt': known are"),
    ],
)
def test_bad_lists_are_told_in_a_sentence(tmp_path, content, said):
    with pytest.raises(DataError, match=said):
        read(tmp_path, content)
