# SPDX-License-Identifier: Apache-2.0
"""A mesh comes back from its files in its place, with its name and its colour."""

from __future__ import annotations

import numpy as np
import trimesh

from raytran.export.mesh import object_name, write_meshes


def test_files_of_a_mesh_hold_the_same_mesh_in_the_world(tmp_path, prediction, box_at):
    names = write_meshes(tmp_path, prediction.objects, [box_at([1, 2, 0.5]), None])
    assert names == ["meshes/00.ply", None]
    assert {path.name for path in (tmp_path / "meshes").iterdir()} == {"00.ply", "00.obj", "00.mtl"}
    ply = trimesh.load(tmp_path / "meshes" / "00.ply", process=False)
    assert np.allclose(ply.bounds, [[0.75, 1.7, 0.0], [1.25, 2.3, 1.0]])
    assert ply.visual.vertex_colors[0].tolist() == [31, 119, 180, 255]
    obj = trimesh.load(tmp_path / "meshes" / "00.obj", process=False)
    assert np.allclose(obj.vertices, ply.vertices, atol=1e-5)
    assert np.array_equal(obj.faces, ply.faces)
    assert obj.visual.material.main_color.tolist() == [31, 119, 180, 255]
    lines = (tmp_path / "meshes" / "00.obj").read_text().splitlines()
    assert {"mtllib 00.mtl", "o 00_chair", "usemtl chair"} <= set(lines)


def test_names(prediction):
    assert [object_name(prediction.objects, i) for i in range(2)] == ["00_chair", "01_table"]


def test_three_js_reads_the_obj(tmp_path, prediction, box_at, read_three):
    write_meshes(tmp_path, prediction.objects, [None, box_at([1, 2, 0.5])])
    found = read_three(tmp_path / "meshes" / "01.obj")
    assert list(found) == ["01_table"]
    assert np.allclose(found["01_table"]["low"], [0.75, 1.7, 0.0])
    assert np.allclose(found["01_table"]["high"], [1.25, 2.3, 1.0])
    assert found["01_table"]["color"] == "2ca02c"
