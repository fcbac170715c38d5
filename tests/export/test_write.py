# SPDX-License-Identifier: Apache-2.0
"""A prediction written as files says what was predicted, where it was predicted."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from raytran.errors import DataError, ShapeError
from raytran.export import read_scene_json, write_prediction
from raytran.structs import ObjectSet, ScenePrediction


def test_scene_json_follows_the_contract(tmp_path, prediction, turned, box_at):
    write_prediction(tmp_path, prediction, [box_at([1, 2, 0.5]), None])
    content = json.loads((tmp_path / "scene.json").read_text())
    assert {k: content[k] for k in ("format", "scene_id", "up", "unit")} == {
        "format": "raytran.scene/1",
        "scene_id": "scene0000_00",
        "up": "+z",
        "unit": "m",
    }
    chair, table = content["objects"]
    assert set(chair) == {
        "category",
        "score",
        "center",
        "size",
        "rotation",
        "yaw",
        "mesh",
        "catid_cad",
        "id_cad",
    }
    assert chair["category"] == "chair"
    assert chair["mesh"] == "meshes/00.ply"
    assert chair["id_cad"] == "abc"
    assert chair["yaw"] == pytest.approx(math.radians(30))
    assert np.allclose(chair["rotation"], turned)
    assert table["category"] == "table"
    assert table["mesh"] is None
    assert "id_cad" not in table


def test_scene_json_reads_back(tmp_path, prediction):
    write_prediction(tmp_path, prediction, [None, None])
    read = read_scene_json(tmp_path / "scene.json")
    assert read.scene_id == "scene0000_00"
    for name in ("label", "center", "size", "rotation", "score"):
        assert torch.equal(getattr(read.objects, name), getattr(prediction.objects, name)), name
    assert read.objects.model_id == ("03001627/abc", "")


def test_every_file_is_there_and_named(tmp_path, prediction, box_at, cameras):
    known = replace(prediction, occupancy=torch.rand(4, 4, 2))
    files = write_prediction(
        tmp_path,
        known,
        [None, box_at([-1, 0, 0.5])],
        cameras=cameras,
        frame_ids=["0", "5"],
        grid_extent=(4.0, 4.0, 2.0),
    )
    assert files[0] == tmp_path / "scene.json"
    below = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert below == {"scene.json", "scene.glb", "occupancy.ply"} | {
        f"meshes/01.{ending}" for ending in ("ply", "obj", "mtl")
    }


def test_no_objects_is_a_valid_scene(tmp_path):
    empty = ScenePrediction("nothing", ObjectSet.empty(), torch.zeros(3))
    write_prediction(tmp_path, empty, [])
    assert len(read_scene_json(tmp_path / "scene.json").objects) == 0
    assert not trimesh.load(tmp_path / "scene.glb").geometry


def test_a_mesh_or_a_name_is_missing(tmp_path, prediction, cameras):
    with pytest.raises(ShapeError, match="got 1 for 2 objects"):
        write_prediction(tmp_path, prediction, [None])
    with pytest.raises(ShapeError, match="got 1 for 2 cameras"):
        write_prediction(tmp_path, prediction, [None, None], cameras=cameras, frame_ids=["0"])
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no scene file at"),
        ("{", "cannot read"),
        ("[" * 100_000, "cannot read"),
        ("9" * 5000, "cannot read"),
        ('{"format": "raytran.scene/1", "scene_id": "a", "objects": ["x"]}', "malformed"),
        (
            '{"format": "raytran.scene/1", "scene_id": "a", "objects": [{"category": "chair", "center": '
            f"[1{'0' * 400}, 0, 0]" + "}]}",
            "malformed",
        ),
        ('{"format": "other"}', "has format 'other'"),
        ('{"format": "raytran.scene/1", "scene_id": "a", "objects": [{"category": "ship"}]}', "malformed"),
    ],
)
def test_damaged_files_are_named(tmp_path, content, message):
    path = tmp_path / "scene.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=message) as caught:
        read_scene_json(path)
    assert str(path) in str(caught.value)
