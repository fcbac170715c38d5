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
from raytran.export import read_scene_json, write_meshes, write_prediction, write_scene_json
from raytran.export.glb import object_name
from raytran.export.write import write_occupancy
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
    assert torch.equal(read.objects.label, prediction.objects.label)
    # Rounded to a tenth of a millimetre, and to a millionth of a turn or a share.
    for name, most in {"center": 6e-5, "size": 6e-5, "rotation": 6e-7, "score": 6e-7}.items():
        written, meant = getattr(read.objects, name), getattr(prediction.objects, name)
        torch.testing.assert_close(written, meant.double(), rtol=0, atol=most)
    assert read.objects.model_id == ("03001627/abc", "")


def test_scene_json_has_a_line_for_each_object_and_the_digits_that_mean_something(tmp_path, prediction):
    objects = replace(
        prediction.objects,
        center=torch.tensor([[1 / 3, -1e-9, 12.3456789], [2.0, 3.0, 4.0]]),
        score=torch.tensor([0.9876543, 0.5]),
    )
    path = write_scene_json(tmp_path / "scene.json", replace(prediction, objects=objects), [None, None])
    lines = path.read_text().splitlines()
    assert len(lines) == 5
    assert lines[0].startswith(
        '{"format": "raytran.scene/1", "scene_id": "scene0000_00", "up": "+z", "unit": "m",'
    )
    assert '"center": [0.3333, 0.0, 12.3457]' in lines[2]
    assert '"score": 0.987654,' in lines[2]
    assert [entry["category"] for entry in json.loads(path.read_text())["objects"]] == ["chair", "table"]
    empty = write_scene_json(tmp_path / "empty.json", replace(prediction, objects=ObjectSet.empty()), [])
    assert json.loads(empty.read_text())["objects"] == []


def test_without_asking_there_is_one_file_a_mesh(tmp_path, prediction, box_at):
    write_meshes(tmp_path, prediction.objects, [box_at([1, 2, 0.5]), None])
    assert [path.name for path in (tmp_path / "meshes").iterdir()] == ["00.ply"]


def test_every_file_is_there_and_named(tmp_path, prediction, box_at, cameras):
    known = replace(prediction, occupancy=torch.rand(4, 4, 2), grid_extent=(4.0, 4.0, 2.0))
    files = write_prediction(
        tmp_path,
        known,
        [None, box_at([-1, 0, 0.5])],
        cameras=cameras,
        frame_ids=["0", "5"],
        obj=True,
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
        ("{", "no valid JSON"),
        ("[" * 100_000, "no valid JSON"),
        ("9" * 5000, "not a JSON object"),
        ('{"format": "raytran.scene/1", "scene_id": "a", "objects": ["x"]}', "no list of objects"),
        (
            '{"format": "raytran.scene/1", "scene_id": "a", "objects": [{"category": "chair", "center": '
            f"[1{'0' * 400}, 0, 0]" + "}]}",
            "size of the objects in",
        ),
        ('{"format": "other"}', "has format 'other'"),
        (
            '{"format": "raytran.scene/1", "scene_id": "a", "objects": [{"category": "ship", "score": 1, '
            '"center": [0, 0, 0], "size": [1, 1, 1], "rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]]}]}',
            "category 'ship'",
        ),
    ],
)
def test_damaged_files_are_named(tmp_path, content, message):
    path = tmp_path / "scene.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=message) as caught:
        read_scene_json(path)
    assert str(path) in str(caught.value)


def test_files_of_a_mesh_hold_the_same_mesh_in_the_world(tmp_path, prediction, box_at):
    names = write_meshes(tmp_path, prediction.objects, [box_at([1, 2, 0.5]), None], obj=True)
    assert names == ["meshes/00.ply", None]
    assert {path.name for path in (tmp_path / "meshes").iterdir()} == {"00.ply", "00.obj", "00.mtl"}
    ply = trimesh.load(tmp_path / "meshes" / "00.ply", process=False)
    assert np.allclose(ply.bounds, [[0.75, 1.7, 0.0], [1.25, 2.3, 1.0]])
    assert ply.visual.vertex_colors[0].tolist() == [31, 119, 180, 255]
    obj = trimesh.load(tmp_path / "meshes" / "00.obj", process=False)
    # The PLY is in the world, +Z up; readers of OBJ take +Y for up.
    assert np.allclose(obj.vertices, ply.vertices[:, [0, 2, 1]] * [1, 1, -1], atol=1e-5)
    assert np.allclose(obj.bounds, [[0.75, 0.0, -2.3], [1.25, 1.0, -1.7]], atol=1e-5)
    assert np.array_equal(obj.faces, ply.faces)
    assert obj.volume > 0
    assert obj.visual.material.main_color.tolist() == [31, 119, 180, 255]
    lines = (tmp_path / "meshes" / "00.obj").read_text().splitlines()
    assert {"mtllib 00.mtl", "o 00_chair", "usemtl chair"} <= set(lines)


def test_names(prediction):
    assert [object_name(prediction.objects, i) for i in range(2)] == ["00_chair", "01_table"]


def test_points_lie_where_the_voxels_are(tmp_path):
    occupancy = torch.full((4, 4, 2), 0.5)
    occupancy[1, 2, 0], occupancy[0, 0, 1] = 0.75, 1.0
    path = write_occupancy(
        tmp_path / "o.ply", occupancy, center=torch.tensor([10.0, 0, 1]), extent=(4.0, 8.0, 2.0)
    )
    cloud = trimesh.load(path)
    # Voxels of 1 x 2 x 1 m from (8, -4, 0) on; z runs fastest.
    assert cloud.vertices.tolist() == [[8.5, -3.0, 1.5], [9.5, 1.0, 0.5]]
    # The last and the middle of viridis' 256 colours.
    assert cloud.colors[:, :3].tolist() == [[253, 231, 36], [32, 144, 140]]
    points = np.frombuffer(
        path.read_bytes().split(b"end_header\n")[1], dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3), ("p", "<f4")]
    )
    assert points["p"].tolist() == [1.0, 0.75]


def test_nothing_is_occupied(tmp_path):
    path = write_occupancy(
        tmp_path / "o.ply", torch.zeros(2, 2, 2), center=torch.zeros(3), extent=(1.0, 1.0, 1.0)
    )
    assert path.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 0\n")
    assert path.read_bytes().endswith(b"end_header\n")


def test_few_views_lower_the_confidence_and_not_the_score(tmp_path, prediction):
    objects = replace(
        prediction.objects, score=torch.tensor([0.9, 0.8]), num_views=torch.tensor([1.0, 19.04])
    )
    path = write_scene_json(tmp_path / "scene.json", replace(prediction, objects=objects), [None, None])
    few, many = json.loads(path.read_text())["objects"]
    assert (few["num_views"], many["num_views"]) == (1.0, 19.0)
    assert (few["score"], many["score"]) == pytest.approx((0.9, 0.8))
    assert few["confidence"] == pytest.approx(0.45)
    assert many["confidence"] == pytest.approx(0.8 * 19.04 / 20.04)
    assert read_scene_json(path).objects.score.tolist() == pytest.approx([0.9, 0.8])


def test_without_counted_views_nothing_is_said_of_them(tmp_path, prediction):
    path = write_scene_json(tmp_path / "scene.json", prediction, [None, None])
    assert not {"num_views", "confidence"} & set(json.loads(path.read_text())["objects"][0])
