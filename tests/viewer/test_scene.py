# SPDX-License-Identifier: Apache-2.0
"""The nodes of a scene, in a viser server that runs without a browser."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from raytran.classes import PAPER_CLASSES, Classes
from raytran.pictures.wireframe import box_corners
from raytran.viewer.attention import ReadPixels
from raytran.viewer.data import read_viewer_scene

from .conftest import write_result

viser = pytest.importorskip("viser", reason="needs viser (pip install 'raytran[viewer]')")
from raytran.viewer.scene import (  # noqa: E402 - after the check
    FIELD_OF_VIEW,
    SceneNodes,
    Shown,
    draw_reads,
    home,
    in_plain_sight,
    names_with_room,
    voxel_colors,
)
from raytran.viewer.server import quiet_server  # noqa: E402


@pytest.fixture(scope="module")
def server():
    with quiet_server() as running:
        yield running


@pytest.fixture
def scene(result):
    return read_viewer_scene(result)


@pytest.fixture
def nodes(server, scene):
    return SceneNodes(server, scene)


def names(server):
    return set(server.scene._handle_from_node_name)


def test_everything_has_a_node(server, nodes):
    assert {"/objects/bathtub/00/mesh", "/objects/bathtub/00/edges", "/objects/chair/03/name"} <= names(
        server
    )
    assert {"/truth/sofa/05", "/frames/0004", "/voxels", "/grid"} <= names(server)
    assert len(nodes.objects) == len(nodes.truth) == 6
    assert len(nodes.frames) == 5
    assert nodes.objects[3].solid.color == PAPER_CLASSES.colors[3]
    assert nodes.objects[3].name.text.startswith("chair 0.")
    assert nodes.frames[1].image.shape == (48, 64, 3)
    np.testing.assert_allclose(nodes.frames[0].position, [3.5, 0.0, 1.6], atol=1e-6)


def test_another_scene_takes_the_place_of_the_first(server, nodes, scene, tmp_path):
    SceneNodes(server, read_viewer_scene(write_result(tmp_path / "room", num_objects=2, with_viewer=False)))
    assert not any(name.startswith(("/truth", "/frames", "/voxels")) for name in names(server))
    assert {name for name in names(server) if name.endswith("mesh")} == {
        "/objects/bathtub/00/mesh",
        "/objects/bookshelf/01/mesh",
    }


def test_own_classes_name_and_colour_the_nodes(server, scene):
    classes = Classes(tuple(f"machine {i}" for i in range(9)), colors=tuple((i, i, i) for i in range(9)))
    own = replace(
        scene,
        objects=replace(scene.objects, classes=classes),
        truth=replace(scene.truth, classes=classes),
    )
    nodes = SceneNodes(server, own)
    assert {"/objects/machine 3/03/mesh", "/truth/machine 5/05"} <= names(server)
    assert nodes.objects[3].solid.color == (3, 3, 3)
    assert nodes.objects[3].name.text.startswith("machine 3 0.")
    nodes.mark_object(0)
    nodes.mark_object(None)
    assert nodes.objects[2].edges.colors.tolist() == [2, 2, 2]


def test_boxes_are_where_the_objects_are(nodes, scene):
    for i, node in enumerate(nodes.objects):
        points = np.concatenate([node.edges.points, node.front.points]).reshape(-1, 3)
        assert len(node.edges.points) + len(node.front.points) == 12
        np.testing.assert_allclose(points.mean(axis=0), scene.objects.center[i], atol=1e-6)
        # The front is the object's -z.
        ahead = -scene.objects.rotation[i, :, 2].numpy()
        offset = node.front.points.reshape(-1, 3) - scene.objects.center[i].numpy()
        np.testing.assert_allclose(offset @ ahead, float(scene.objects.size[i, 2]) / 2, atol=1e-6)


def test_an_object_without_a_mesh_is_a_box_to_click(server, tmp_path):
    folder = write_result(tmp_path / "room", num_objects=2)
    (folder / "meshes" / "00.ply").unlink()
    scene = read_viewer_scene(folder)
    nodes = SceneNodes(server, scene)
    assert isinstance(nodes.objects[0].solid, viser.BoxHandle)
    assert tuple(nodes.objects[0].solid.dimensions) == pytest.approx((0.8, 0.6, 0.5))
    nodes.apply(Shown(meshes=False))
    assert nodes.objects[0].solid.visible
    assert not nodes.objects[1].solid.visible
    nodes.apply(Shown(boxes=False))
    assert not nodes.objects[0].solid.visible


def test_layers_score_and_classes_hide_nodes(server, nodes):
    first, last = nodes.objects[0], nodes.objects[-1]
    assert not nodes.voxels.visible
    nodes.apply(Shown(min_score=0.9, names=False, voxels=True, grid=False))
    assert [first.solid.visible, first.edges.visible, first.name.visible] == [True, True, False]
    assert [last.solid.visible, last.edges.visible, last.front.visible] == [False] * 3
    assert nodes.voxels.visible
    assert not server.scene.world_axes.visible
    nodes.apply(Shown(hidden_classes=frozenset({0})))
    assert [node.solid.visible for node in nodes.objects] == [False, *[True] * 5]
    assert [node.visible for node in nodes.truth] == [False, *[True] * 5]
    nodes.apply(Shown(truth=False, frames=False), np.arange(6) < 2)
    assert not any(node.visible for node in [*nodes.truth, *nodes.frames.values()])
    assert [node.name.visible for node in nodes.objects] == [True, True, *[False] * 4]


def test_voxels_above_a_threshold_in_colours_of_a_scale(nodes, scene):
    occupied = scene.occupancy >= 0.5
    assert len(nodes.voxels.batched_positions) == int(occupied.sum()) > 50
    colors = voxel_colors(scene.volumes[0], "probability")
    assert len(np.unique(colors[occupied], axis=0)) == 1
    assert colors[occupied][0].tolist() == [189, 222, 38]  # viridis at 0.9
    nodes.show_voxels(0.95, "probability")
    assert len(nodes.voxels.batched_positions) == 0
    nodes.show_voxels(0.02, "views")
    colors, count = voxel_colors(scene.volumes[0], "views"), scene.volumes[0].view_count
    assert (colors[count == 0] == (192, 57, 43)).all()
    assert (colors[count == count.max()] == (253, 231, 36)).all()
    assert np.array_equal(nodes.voxels.batched_colors, colors[scene.occupancy >= 0.02])


def test_what_a_voxel_read_is_drawn_on_the_frames(server, nodes, scene):
    pixels = ReadPixels(
        view=np.array([1, 1, 3]),
        row=np.array([0, 2, 1]),
        column=np.array([3, 0, 1]),
        weight=np.array([0.5, 0.25, 0.25]),
        feature_size=(3, 4),
    )
    nodes.mark_voxel(np.zeros(3), np.ones(3), pixels)
    marked = nodes.frames[1].image.astype(int)
    assert np.array_equal(marked, draw_reads(scene.images[1], pixels, 1))
    # Cells are 16 pixels large: the strongest is orange, half as strong ones less so, all else is dark.
    strong, weak, dark = marked[8, 56], marked[40, 8], marked[24, 24]
    assert np.abs(strong - (255, 176, 0)).max() < 26
    assert (strong[:2] > weak[:2]).all()
    assert np.abs(dark - 0.45 * scene.images[1][24, 24]).max() <= 1
    assert (nodes.frames[0].image <= 0.45 * 255 + 1).all()
    rays = server.scene.get_handle_by_name("/voxel/rays")
    np.testing.assert_allclose(rays.points[:, 1], scene.cameras.position[[1, 3]], atol=1e-6)
    assert server.scene.get_handle_by_name("/voxel/cube").points.shape == (12, 2, 3)
    nodes.unmark_voxel()
    assert "/voxel/rays" not in names(server)
    assert np.array_equal(nodes.frames[1].image, scene.images[1])
    nodes.mark_voxel(np.zeros(3), np.ones(3), None)
    assert "/voxel/cube" in names(server)


def test_a_chosen_object_and_frame_stand_out(nodes):
    nodes.mark_object(2)
    assert nodes.objects[2].edges.colors.tolist() == [0, 0, 0]
    assert nodes.objects[1].edges.colors.tolist() == list(PAPER_CLASSES.colors[1])
    nodes.mark_object(None)
    assert nodes.objects[2].front.colors.tolist() == list(PAPER_CLASSES.colors[2])
    nodes.mark_frame(4)
    assert [nodes.frames[n].color == (255, 176, 0) for n in range(5)] == [False] * 4 + [True]


def test_a_picture_is_the_backdrop_until_the_camera_leaves(nodes, scene):
    depth = [frustum.scale for frustum in nodes.frames.values()]
    nodes.set_backdrop(2)
    there = scene.cameras.position[2].numpy()
    nodes.leave_backdrop(there + 1.0)  # a message from before the camera came
    assert nodes.frames[2].scale == pytest.approx(15 / 0.16 * depth[2])
    assert nodes.frames[1].scale == depth[1]
    nodes.leave_backdrop(there)
    nodes.leave_backdrop(there + 0.1)
    assert [frustum.scale for frustum in nodes.frames.values()] == depth


@pytest.mark.parametrize("look", ["all", "top", "front"])
@pytest.mark.parametrize("aspect", [0.46, 1.0, 1.6])
def test_the_scene_fills_the_picture(scene, look, aspect):
    position, target = home(scene, aspect, look)
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0, 0, 1.0], back)
    axes = np.stack([right / np.linalg.norm(right), np.cross(back, right / np.linalg.norm(right)), -back])
    boxes = [box_corners(objects).double().numpy().reshape(-1, 3) for objects in (scene.objects, scene.truth)]
    points = np.concatenate([*boxes, scene.cameras.position.double().numpy()])
    x, y, depth = axes @ (points - position).T
    on_screen = np.stack([x / depth / aspect, y / depth]) / np.tan(FIELD_OF_VIEW / 2)
    assert depth.min() > 0.5
    assert np.abs(on_screen).max() == pytest.approx(0.9, abs=0.01)
    # Of the axis that decides both ends touch: the scene is in the middle.
    tight = np.abs(on_screen).max(axis=1).argmax()
    assert on_screen[tight].min() == pytest.approx(-on_screen[tight].max(), abs=0.01)


def test_a_scene_of_nothing_is_looked_at_too(server, tmp_path):
    empty = read_viewer_scene(write_result(tmp_path / "room", num_objects=0, with_viewer=False))
    assert np.isfinite(home(empty)).all()
    nodes = SceneNodes(server, empty)
    np.testing.assert_allclose(server.initial_camera.position, home(empty)[0])
    assert nodes.texts == []


def test_the_floor_has_lines_at_whole_metres_below_everything(server, nodes):
    grid = server.scene.get_handle_by_name("/grid")
    low = np.array(grid.position[:2]) - np.array([grid.width, grid.height]) / 2
    assert (low % 1 == 0).all()
    assert (np.array([grid.width, grid.height]) % 2 == 0).all()
    assert (low < -3.5).all()
    assert (low + np.array([grid.width, grid.height]) > 3.5).all()
    assert grid.position[2] == pytest.approx(0.0, abs=1e-6)
    assert server.scene.world_axes.visible


def test_no_name_covers_that_of_a_surer_object():
    camera = SimpleNamespace(
        position=np.zeros(3), wxyz=np.array([1.0, 0, 0, 0]), fov=np.pi / 2, image_height=400, image_width=400
    )
    points = np.array([[0, 0, 2.0], [0.1, 0, 2.0], [0, 0.4, 2.0], [1.0, 0, 2.0], [0, 0, -2.0]])
    text = ["chair 0.90"] * 5
    everything = np.ones(5, dtype=bool)
    assert names_with_room(points, text, camera, everything).tolist() == [True, False, True, True, False]
    without_first = everything & (np.arange(5) > 0)
    assert names_with_room(points, text, camera, without_first).tolist() == [False, True, True, True, False]
    assert names_with_room(np.zeros((0, 3)), [], camera, np.zeros(0, dtype=bool)).tolist() == []


def test_the_chosen_name_comes_before_surer_ones():
    camera = SimpleNamespace(
        position=np.zeros(3), wxyz=np.array([1.0, 0, 0, 0]), fov=np.pi / 2, image_height=400, image_width=400
    )
    points, text = np.array([[0, 0, 2.0], [0.1, 0, 2.0], [0, 0.4, 2.0]]), ["chair 0.90"] * 3
    everything = np.ones(3, dtype=bool)
    assert names_with_room(points, text, camera, everything, 1).tolist() == [False, True, True]
    assert names_with_room(points, text, camera, everything, 2).tolist() == [True, False, True]


def test_names_behind_another_object_are_hidden(scene):
    objects = scene.objects.select(torch.arange(3))
    objects = replace(
        objects,
        center=torch.tensor([[0.0, 0, 0.5], [2.0, 0, 0.5], [0.0, 0, 0.7]]),
        size=torch.tensor([[1.0, 1, 1], [1.0, 1, 1], [0.4, 0.2, 0.4]]),
        rotation=objects.rotation[:1].expand(3, 3, 3),
    )
    points = np.array([[0.0, 0, 0.9], [2.0, 0, 1.0], [0.0, 0, 0.9]])
    # Low from the left the first box hides the second's name; of those within it it hides none.
    assert in_plain_sight(points, np.array([-3.0, 0, 0.5]), objects).tolist() == [True, False, True]
    assert in_plain_sight(points, np.array([1.0, 0, 9.0]), objects).tolist() == [True, True, True]
    assert in_plain_sight(points[:0], np.zeros(3), objects.select(torch.arange(0))).tolist() == []


def test_an_export_is_coarser_smaller_and_tells_errors(server, tmp_path, monkeypatch):
    monkeypatch.setattr("raytran.viewer.scene._MAX_FACES", 3000)
    monkeypatch.setattr("raytran.viewer.scene._MAX_FRAMES", 3)
    scene = read_viewer_scene(
        write_result(tmp_path / "room", num_objects=3, size=(480, 640), subdivisions=4, num_frames=7)
    )
    whole, export = SceneNodes(server, scene), SceneNodes(server, scene, export=True)
    counts = [[len(node.solid.faces) for node in nodes.objects] for nodes in (whole, export)]
    assert counts[0] == [5120] * 3
    assert 500 < sum(counts[1]) <= 3000
    for before, after in zip(whole.objects, export.objects, strict=True):
        for end in (np.min, np.max):
            np.testing.assert_allclose(
                end(before.solid.vertices, axis=0), end(after.solid.vertices, axis=0), atol=0.03
            )
    assert list(export.frames) == [1, 3, 5]
    assert export.frames[1].image.shape == (240, 320, 3)
    assert export.objects[0].name.text == "bathtub 0.95 ✓\n0 cm, 0°"
    assert export.objects[1].name.text == "bookshelf 0.75 ✗\n30 cm, 0°"
    # Not by colour alone: the sign tells found from missed without the file's errors too.
    assert whole.objects[0].name.text == "bathtub 0.95 ✓"
    assert whole.objects[1].name.text == "bookshelf 0.75 ✗"
    assert export.objects[0].name.font_size_mode == "scene"
