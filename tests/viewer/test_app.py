# SPDX-License-Identifier: Apache-2.0
"""The panel and the clicks, in a viser server that runs without a browser."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from raytran.errors import DataError
from raytran.viewer.attention import ReadPixels

from .conftest import write_result

viser = pytest.importorskip("viser", reason="needs viser (pip install 'raytran[viewer]')")
from raytran.viewer.app import ViewerApp, describe_reads, draw_boxes, first_hit  # noqa: E402 - after the check
from raytran.viewer.scene import Shown, draw_reads  # noqa: E402
from raytran.viewer.server import quiet_server  # noqa: E402


@pytest.fixture(scope="module")
def scenes(result, tmp_path_factory):
    other = tmp_path_factory.mktemp("viewer")
    return {
        "room": result,
        "plain": write_result(other / "plain", num_objects=2, with_viewer=False),
        "parts": write_result(other / "parts", in_parts=True),
        "empty": write_result(other / "empty", num_objects=0, num_frames=1),
    }


@pytest.fixture
def app(scenes):
    with quiet_server() as server:
        yield ViewerApp(server, scenes)


def shown(app):
    return [node.solid.visible for node in app.nodes.objects]


def set_value(control, value):
    """Set a control as a browser does, and wait for what follows."""
    for callback in control._impl.update_cb:
        control._impl.value = value
        callback(SimpleNamespace(target=control, client=None))


def test_the_slider_and_the_classes_hide_objects(app):
    assert (app.score.min, app.score.value) == (0.55, 0.55)
    assert shown(app) == [True] * 6
    set_value(app.score, 0.8)
    assert shown(app) == [True, True, False, False, False, False]
    assert "**2 of 6** objects" in app.table.content
    set_value(app.classes[0], False)
    assert shown(app) == [False, True, False, False, False, False]
    assert "missed: 1 bathtub, 1 bookshelf" in app.table.content
    set_value(app.layers["meshes"], False)
    assert shown(app) == [False] * 6
    assert app.nodes.objects[1].edges.visible


def test_errors_stand_beside_objects(app):
    lines = app.table.content.splitlines()
    assert lines[0] == (
        "**6 of 6** objects, **1 of 6** true ones found; "
        "missed: 1 bookshelf, 1 cabinet, 1 chair, 1 display, 1 sofa"
    )
    assert lines[4] == "| 00 bathtub ✓ | 0.95 | 0.0 | 0 | 0% | 1.00 |"
    assert lines[5].startswith("| 01 bookshelf ✗ | 0.87 | 30.0 | 0 | 0% | 0.")


def test_an_object_is_chosen_by_a_click_or_by_name(app):
    app.nodes.objects[3].solid._impl.click_cb[0].callback(SimpleNamespace())
    assert app.object == 3
    assert app.choice.value == "03 chair 0.71"
    assert app.details.content.startswith(
        "0.80 × 0.60 × 0.50 m (width × height × depth) at (0.50, -2.00, 0.30). "
    )
    assert "beyond the limits" in app.details.content
    assert app.nodes.objects[3].edges.colors.tolist() == [0, 0, 0]
    set_value(app.choice, "none")
    assert (app.object, app.details.content) == (None, "")
    app.select_object(0)
    assert "Found: true object 0" in app.details.content


def test_frames_are_chosen_by_the_slider_or_a_frustum(app):
    assert app.picture.label == "000000, 1 of 5"
    set_value(app.frame_slider, 2)
    assert (app.frame, app.picture.label) == (2, "000020, 3 of 5")
    app.nodes.frames[4]._impl.click_cb[0].callback(SimpleNamespace())
    assert (app.frame_slider.value, app.picture.label) == (4, "000040, 5 of 5")
    plain = app.scene.images[4]
    boxes = draw_boxes(plain, app.scene.camera(4), app.scene.objects)
    assert np.array_equal(app.picture.image, boxes)
    large = plain.repeat(8, axis=0).repeat(8, axis=1)  # 64 pixels become 512
    changed = (boxes != large).any(axis=2)
    assert 0.01 < changed.mean() < 0.3
    set_value(app.score, 1.0)
    assert np.array_equal(app.picture.image, large)


def click(app, point, start=(0.0, 0.0, 8.0)):
    """Shift-click so that the ray goes through a point."""
    direction = np.array(point) - np.array(start)
    event = SimpleNamespace(ray_origin=tuple(start), ray_direction=tuple(direction))
    (entry,) = app.server.scene._scene_pointer_cb
    assert (entry.event_type, entry.modifier) == ("click", "shift")
    entry.callback(event)


def test_a_click_on_a_voxel_lights_up_the_pixels_it_read(app):
    app.nodes.voxels._impl.click_cb[0].callback(
        SimpleNamespace(ray_origin=(1.2, 0.3, 5.0), ray_direction=(0.0, 0.0, -1.0))
    )
    voxel = (10, 8, 1)  # 1.2 and 0.3 m in voxels of half a metre; those up to 0.5 m are occupied
    pixels = app.scene.volumes[0].pixels_of(voxel)
    assert np.array_equal(app.pixels.column, pixels.column)
    share = np.bincount(pixels.view, pixels.weight, minlength=5)
    assert app.frame == share.argmax()
    assert app.reads.content.startswith(f"voxel {voxel} read {len(pixels.view)} pixels of")
    for n, frustum in app.nodes.frames.items():
        assert np.array_equal(frustum.image, draw_reads(app.scene.images[n], pixels, n))
    app.select_voxel(None)
    assert app.pixels is None
    assert "Shift-click" in app.reads.content
    assert np.array_equal(app.nodes.frames[0].image, app.scene.images[0])


def test_shift_click_finds_meshes_and_voxels_that_are_hidden(app):
    # Object 0 stands left of everything that is occupied; its mesh is 0.6 m high.
    x, y, _ = app.scene.objects.center[0].tolist()
    click(app, (x, y, 0.3), start=(x, y, 8.0))
    assert app.reads.content.startswith("voxel (3, 4, 2) read")
    set_value(app.classes[0], False)
    click(app, (x, y, 0.3), start=(x, y, 8.0))
    assert "Shift-click" in app.reads.content
    click(app, (1.2, 0.3, 0.4), start=(1.2, 0.3, 8.0))
    assert app.reads.content.startswith("voxel (10, 8, 1) read")


def test_a_ray_meets_what_is_nearest(app):
    down = np.array([0.0, 0.0, -3.0])
    x, y, _ = app.scene.objects.center[0].tolist()
    hit = first_hit(app.scene, Shown(), 0.5, np.array([x, y, 4.0]), down)
    assert hit == pytest.approx([x, y, 0.6 - 1e-3], abs=0.01)
    assert first_hit(app.scene, Shown(min_score=1.0), 0.5, np.array([x, y, 4.0]), down) is None
    assert first_hit(app.scene, Shown(), 0.95, np.array([1.2, 0.45, 4.0]), down) is None
    assert first_hit(app.scene, Shown(), 0.5, np.array([1.2, 0.45, 4.0]), -down) is None


def test_voxels_are_coloured_by_a_scale_that_is_told(app):
    show = app.occupancy._impl.update_cb
    before = app.nodes.voxels
    set_value(app.occupancy, 0.95)
    assert len(show) == 1
    assert app.nodes.voxels is not before
    assert len(app.nodes.voxels.batched_positions) == 0
    set_value(app.occupancy, 0.3)
    assert len(app.nodes.voxels._impl.click_cb) == 1


def test_another_scene_is_opened_and_has_its_own_panel(app):
    app.open("plain")
    assert len(app.nodes.objects) == 2
    assert (app.picture, app.occupancy, app.frame_slider) == (None, None, None)
    assert app.table.content.splitlines()[0] == "**2 of 2** objects"
    app.open("parts")
    app.select_voxel(np.array([2.0, 0.0, 0.3]))
    assert set(app.pixels.view.tolist()) <= {2, 3, 4}
    app.open("empty")
    assert app.frame_slider is None
    assert app.picture.label == "000000, 1 of 1"


def test_a_damaged_scene_is_said_to_whom_chose_it(app, tmp_path):
    app.scenes = {**app.scenes, "broken": tmp_path}
    with pytest.raises(DataError, match="no scene file"):
        app.open("broken")
    told = []
    client = SimpleNamespace(add_notification=lambda *words, **_: told.append(words))
    app._open_chosen(SimpleNamespace(target=SimpleNamespace(value="broken"), client=client))
    assert told[0][0] == "cannot show broken"
    assert len(app.nodes.objects) == 6


def test_names_give_way_to_surer_ones_as_the_camera_moves(app):
    far = SimpleNamespace(
        position=np.array([0.0, 0.0, 400.0]),
        wxyz=np.array([0.0, 1.0, 0.0, 0.0]),  # straight down
        fov=0.87,
        image_height=800,
        image_width=800,
    )
    app.move(far)
    assert [node.name.visible for node in app.nodes.objects] == [True, *[False] * 5]
    app.move(SimpleNamespace(**vars(far) | {"position": np.array([0.0, 0.0, 4.0])}))
    assert all(node.name.visible for node in app.nodes.objects)


def test_a_camera_looks_from_a_frame_and_back(app):
    camera = SimpleNamespace(aspect=1.5)
    client = SimpleNamespace(camera=camera, atomic=app.server.atomic)
    app.select_frame(1)
    app._look_from_frame(client)
    pose = app.scene.cameras.world_from_camera[1].numpy()
    np.testing.assert_allclose(camera.position, pose[:3, 3])
    np.testing.assert_allclose(viser.transforms.SO3(camera.wxyz).as_matrix(), pose[:3, :3], atol=1e-6)
    assert np.tan(camera.fov / 2) == pytest.approx(24 / (0.8 * 64))
    assert app.nodes.frames[1].scale > 10 * app.nodes.frames[0].scale
    app._look(client)
    np.testing.assert_allclose(camera.position, app.server.initial_camera.position)
    app._look(client, "top")
    assert camera.position[2] > 5
    np.testing.assert_allclose(camera.position[:2], camera.look_at[:2], atol=0.05)
    app._look(None)


def test_keys_and_buttons_look_at_all_of_the_scene(app, scenes):
    for _ in range(2):  # a scene that is opened later has them too, once
        commands = list(app.server.gui._command_handle_from_uuid.values())
        assert [command.hotkey for command in commands] == ["F", "T", "N"]
        app.open("plain")
    camera = SimpleNamespace(aspect=0.5)
    client = SimpleNamespace(camera=camera, atomic=app.server.atomic)
    commands = list(app.server.gui._command_handle_from_uuid.values())
    commands[2]._impl.trigger_cb[0](SimpleNamespace(client=client))
    assert camera.position[1] < camera.look_at[1] - 3
    assert camera.position[2] == pytest.approx(camera.look_at[2])


def test_who_looks_from_a_frame_stays_there(app, monkeypatch):
    looks = []
    monkeypatch.setattr(app.server, "get_clients", lambda: {0: "browser"})
    monkeypatch.setattr(app, "_look_from_frame", looks.append)
    app.select_frame(1)
    app.nodes.set_backdrop(1)
    assert [frustum.visible for frustum in app.nodes.frames.values()] == [n == 1 for n in range(5)]
    app.select_voxel(np.array([1.2, 0.3, 0.4]))
    assert (app.frame, app.nodes.backdrop, looks) == (1, 1, [])
    assert app.picture.label == "000010, 2 of 5"
    set_value(app.frame_slider, 3)
    assert looks == ["browser"]
    app.nodes.set_backdrop(None)
    assert all(frustum.visible for frustum in app.nodes.frames.values())


def test_a_finger_chooses_what_to_read_by_the_next_tap(app):
    app._pick(None)
    plain = [entry for entry in app.server.scene._scene_pointer_cb if entry.modifier is None]
    event = SimpleNamespace(ray_origin=(1.2, 0.3, 8.0), ray_direction=(0.0, 0.0, -1.0))
    plain[0].callback(event)
    assert app.reads.content.startswith("voxel (10, 8, 1) read")
    assert [entry.modifier for entry in app.server.scene._scene_pointer_cb] == ["shift"]


def test_the_scale_of_the_voxels_is_seen_with_the_voxels(app):
    assert not app.voxel_panel.visible
    set_value(app.layers["voxels"], True)
    assert app.voxel_panel.visible
    assert app.nodes.voxels.visible


def test_the_chosen_object_keeps_its_name(app):
    far = SimpleNamespace(
        position=np.array([0.0, 0.0, 400.0]),
        wxyz=np.array([0.0, 1.0, 0.0, 0.0]),
        fov=0.87,
        image_height=800,
        image_width=800,
    )
    app.move(far)
    app.select_object(3)
    assert [node.name.visible for node in app.nodes.objects] == [n == 3 for n in range(6)]
    app.select_object(None)
    assert [node.name.visible for node in app.nodes.objects] == [n == 0 for n in range(6)]


def test_a_browser_begins_with_all_of_the_scene_in_its_window(app):
    (connect,) = app.server._client_connect_cb
    distance = []
    for width in (390, 1280):
        camera = SimpleNamespace(
            position=np.array([0.0, 0.0, 9.0]),
            wxyz=np.array([0.0, 1.0, 0.0, 0.0]),
            fov=0.87,
            image_height=800,
            image_width=width,
            aspect=width / 800,
            on_update=lambda _: None,
        )
        connect(SimpleNamespace(camera=camera, atomic=app.server.atomic))
        distance.append(np.linalg.norm(np.array(camera.position) - camera.look_at))
    assert distance[0] > 1.5 * distance[1]


def test_what_was_read_is_counted_in_words():
    def reads(view):
        count = len(view)
        zeros = np.zeros(count, dtype=int)
        return ReadPixels(np.array(view, dtype=int), zeros, zeros, np.full(count, 1 / count), (3, 4))

    assert describe_reads((1, 2, 3), reads([1]), "ab") == "voxel (1, 2, 3) read 1 pixel of one frame, b."
    assert describe_reads((1, 2, 3), reads([0, 1, 1, 1]), "ab") == (
        "voxel (1, 2, 3) read 4 pixels of 2 frames, most from b 75%, a 25%."
    )
