# SPDX-License-Identifier: Apache-2.0
"""A prediction written as files says what was predicted, where it was predicted."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
import trimesh

from raytran.errors import DataError, ShapeError
from raytran.export import read_scene_json, write_prediction
from raytran.types import ObjectSet, ScenePrediction

# world_from_object of an upright object turned by 30 degrees: width along (cos 30, sin 30, 0), up along z.
COS, SIN = math.sqrt(3) / 2, 0.5
TURNED = [[COS, 0.0, SIN], [SIN, 0.0, -COS], [0.0, 1.0, 0.0]]


def prediction() -> ScenePrediction:
    objects = ObjectSet(
        label=torch.tensor([3, 6]),
        center=torch.tensor([[1.0, 2.0, 0.5], [-1.0, 0.0, 0.375]]),
        size=torch.tensor([[0.5, 1.0, 0.6], [1.6, 0.75, 0.8]]),
        rotation=torch.tensor([TURNED, TURNED]),
        symmetry=torch.ones(2, dtype=torch.int64),
        score=torch.tensor([0.75, 0.5]),
        model_id=("03001627/abc", ""),
    )
    return ScenePrediction("scene0000_00", objects, torch.zeros(3))


def box_at(center: list[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(
        extents=(0.5, 0.6, 1.0), transform=trimesh.transformations.translation_matrix(center)
    )


def test_scene_json_follows_the_contract(tmp_path):
    write_prediction(tmp_path, prediction(), [box_at([1, 2, 0.5]), None])
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
    assert np.allclose(chair["rotation"], TURNED)
    assert table["category"] == "table"
    assert table["mesh"] is None
    assert "id_cad" not in table


def test_scene_json_reads_back(tmp_path):
    write_prediction(tmp_path, prediction(), [None, None])
    read = read_scene_json(tmp_path / "scene.json")
    assert read.scene_id == "scene0000_00"
    for name in ("label", "center", "size", "rotation", "score"):
        assert torch.equal(getattr(read.objects, name), getattr(prediction().objects, name)), name
    assert read.objects.model_id == ("03001627/abc", "")


def test_meshes_lie_in_the_world_and_glb_is_upright(tmp_path):
    write_prediction(tmp_path, prediction(), [box_at([1, 2, 0.5]), box_at([-1, 0, 0.5])])
    ply = trimesh.load(tmp_path / "meshes" / "00.ply", process=False)
    assert np.allclose(ply.bounds, [[0.75, 1.7, 0.0], [1.25, 2.3, 1.0]])
    assert ply.visual.vertex_colors[0].tolist() == [31, 119, 180, 255]
    scene = trimesh.load(tmp_path / "scene.glb")
    assert set(scene.graph.nodes_geometry) == {"00_chair", "01_table"}
    world_from_node, geometry = scene.graph["00_chair"]
    assert np.allclose(scene.geometry[geometry].bounds, ply.bounds, atol=1e-6)
    # The world's +Z is glTF's +Y, and the turn is proper.
    assert np.allclose(world_from_node[:3, :3] @ [0, 0, 1], [0, 1, 0])
    assert np.linalg.det(world_from_node[:3, :3]) == pytest.approx(1)
    assert scene.geometry[geometry].visual.material.baseColorFactor.tolist() == [31, 119, 180, 255]


def test_no_objects_is_a_valid_scene(tmp_path):
    empty = ScenePrediction("nothing", ObjectSet.empty(), torch.zeros(3))
    write_prediction(tmp_path, empty, [])
    assert len(read_scene_json(tmp_path / "scene.json").objects) == 0
    assert not trimesh.load(tmp_path / "scene.glb").geometry


def test_a_mesh_is_missing(tmp_path):
    with pytest.raises(ShapeError, match="got 1 for 2 objects"):
        write_prediction(tmp_path, prediction(), [None])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no scene file at"),
        ("{", "cannot read"),
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
