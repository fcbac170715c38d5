# SPDX-License-Identifier: Apache-2.0
"""The glTF scene in two programs that read it: names, places, colours, cameras."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from raytran.export import write_meshes
from raytran.export.glb import write_glb
from raytran.structs import ObjectSet

NODES = {"00_chair", "00_chair_box", "01_table_box"}

Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])

# The chair's box is 0.5 x 0.6 m on the floor, turned by 30 degrees round (1, 2), and 1 m high; the edges of
# its front are 16 mm thick, those behind 8 mm.
HALF_X, HALF_Y = 0.25 * 0.866 + 0.3 * 0.5, 0.25 * 0.5 + 0.3 * 0.866


@pytest.fixture
def glb(tmp_path, prediction, box_at, cameras) -> Path:
    return write_glb(
        tmp_path / "scene.glb",
        prediction.objects,
        [box_at([1, 2, 0.5]), None],
        cameras=cameras,
        frame_ids=["0", "5"],
    )


def in_the_world(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh of the file, +Y up, where the poses have it, +Z up."""
    return mesh.copy().apply_transform(Z_UP_FROM_Y_UP)


def content(path: Path) -> dict:
    data = path.read_bytes()
    return json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])


def test_trimesh_finds_every_node_in_its_place(glb):
    scene = trimesh.load(glb)
    assert set(scene.graph.nodes_geometry) == NODES
    chair = in_the_world(scene.geometry[scene.graph["00_chair"][1]])
    assert np.allclose(chair.bounds, [[0.75, 1.7, 0.0], [1.25, 2.3, 1.0]], atol=1e-6)
    box = in_the_world(scene.geometry[scene.graph["00_chair_box"][1]])
    assert np.allclose(box.bounds, [[1 - HALF_X, 2 - HALF_Y, 0], [1 + HALF_X, 2 + HALF_Y, 1]], atol=0.015)
    assert len(box.split()) == 12
    # The front is at -Z of the object, which is (-sin 30, cos 30, 0) from its middle.
    front = (box.triangles_center - [1, 2, 0.5]) @ [-0.5, 0.866, 0] > 0.25
    assert box.area_faces[front].sum() > 1.3 * box.area_faces[~front].sum() / 2


def test_vertices_are_upright_for_readers_that_ignore_nodes(glb, tmp_path, prediction, box_at):
    scene = trimesh.load(glb, process=False)
    for name in NODES:
        pose, geometry = scene.graph[name]
        assert np.array_equal(pose, np.eye(4)), "with the nodes everything is in the same place"
        bounds = scene.geometry[geometry].bounds
        assert bounds[0, 1] == pytest.approx(0, abs=0.02), "it stands on the floor, y = 0"
        assert bounds[1, 1] == pytest.approx(0.75 if "table" in name else 1, abs=0.02)
    write_meshes(tmp_path, prediction.objects, [box_at([1, 2, 0.5]), None])
    ply = trimesh.load(tmp_path / "meshes" / "00.ply", process=False)
    chair = scene.geometry[scene.graph["00_chair"][1]]
    assert in_the_world(chair).volume > 0, "faces still run counter-clockwise"
    assert {tuple(point) for point in in_the_world(chair).vertices} == {
        tuple(point) for point in ply.vertices
    }


def test_colours_are_linear_light(glb):
    colors = {m["name"]: m["pbrMetallicRoughness"]["baseColorFactor"] for m in content(glb)["materials"]}
    # (31, 119, 180) and (44, 160, 44) by IEC 61966-2-1.
    assert colors["chair"] == pytest.approx([0.01370, 0.18447, 0.45641, 1], abs=1e-4)
    assert colors["table"] == pytest.approx([0.02519, 0.35153, 0.02519, 1], abs=1e-4)


def test_cameras_look_where_the_frames_do(glb):
    tree = content(glb)
    nodes = {node["name"]: node for node in tree["nodes"]}
    assert [tree["nodes"][i]["name"] for i in nodes["cameras"]["children"]] == ["camera_0", "camera_5"]
    assert "matrix" not in nodes["scene_y_up"]
    pose = Z_UP_FROM_Y_UP @ np.array(nodes["camera_5"]["matrix"]).reshape(4, 4).T
    assert np.allclose(pose[:3, 3], [0.25, -3, 1.5])
    assert np.allclose(pose[:3, :3] @ [0, 0, -1], [0, 1, 0])  # glTF's forward
    assert np.allclose(pose[:3, :3] @ [0, 1, 0], [0, 0, 1])  # and up
    lens = tree["cameras"][1]["perspective"]
    assert np.tan(lens["yfov"] / 2) == pytest.approx(60 / 120)
    assert lens["aspectRatio"] * np.tan(lens["yfov"] / 2) == pytest.approx(80 / 100)


def test_an_empty_scene_loads(tmp_path):
    path = write_glb(tmp_path / "scene.glb", ObjectSet.empty(), [])
    assert not trimesh.load(path).geometry
    assert [node["name"] for node in content(path)["nodes"]] == ["scene_y_up"]
