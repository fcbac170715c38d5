# SPDX-License-Identifier: Apache-2.0
"""Axes, up and unit: measured, checked, corrected or reported; and images that were stored sideways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from raytran.capture.colmap import read_colmap
from raytran.capture.orientation import (
    WorldSettings,
    check_unit,
    check_up,
    rotate_upright,
    rotation_to_z,
    to_our_world,
)
from raytran.capture.recording import open_recording
from raytran.data.scannet.scan import read_scan
from raytran.errors import ConfigError

from .forms import OPENGL, write_colmap

BLIND = WorldSettings(check=False)
Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.fixture
def scan(walk):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    return open_recording(read_colmap(walk.folder))


@pytest.fixture(scope="module")
def furnished(room):
    """The scan of a furnished room of 20 frames."""
    return read_scan(room / "scannet" / "scans" / "scene0000_00")


def moved(scan, turn=None, scale=1.0, camera=None):
    poses = scan.world_from_camera.double().numpy() @ (np.eye(4) if camera is None else camera)
    poses[:, :3] = (np.eye(3) if turn is None else turn) @ poses[:, :3]
    poses[:, :3, 3] *= scale
    return replace(scan, world_from_camera=torch.from_numpy(poses))


def same_shape(first, second):
    """Whether two walks are equal up to a turn about +z."""
    a, b = first.world_from_camera.numpy(), second.world_from_camera.numpy()
    turn = b[0, :3, :3] @ a[0, :3, :3].T
    assert turn[2, 2] == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(turn @ a[:, :3], b[:, :3], atol=1e-6)


def test_a_world_that_is_ours_is_left_alone(scan, caplog):
    caplog.set_level("INFO")
    assert to_our_world(scan, BLIND).world_from_camera is scan.world_from_camera
    assert [record.levelname for record in caplog.records] == ["INFO"]
    assert "up is +z (measured from the cameras, certain)" in caplog.text


@pytest.mark.parametrize(
    ("turn", "name"),
    [
        (Y_UP_FROM_Z_UP, "+y"),
        (Y_UP_FROM_Z_UP.T, "-y"),
        (np.diag([1.0, -1.0, -1.0]), "-z"),
        (np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), "+x"),
    ],
)
def test_up_is_found_from_the_cameras_or_given(scan, caplog, turn, name):
    other = moved(scan, turn)
    same_shape(to_our_world(other, BLIND), scan)
    assert f"up is {name} (measured from the cameras, certain)" in caplog.text
    same_shape(to_our_world(other, replace(BLIND, up=name)), scan)
    assert f"up is {name} (as up= says)" in caplog.text
    promised = tuple(turn @ [0.0, 0.0, 1.0])
    same_shape(to_our_world(other, BLIND, up=promised), scan)
    assert f"up is {name} (as the format has it)" in caplog.text


def test_a_world_that_leans_in_all_ways_is_levelled_from_the_cameras(scan, caplog):
    other = moved(scan, Rotation.from_euler("xyz", [0.6, -0.9, 2.0]).as_matrix())
    level = to_our_world(other, BLIND)
    # As exact as cameras are held level; these are.
    assert float(level.world_from_camera[:, 2, 2].max()) == pytest.approx(np.sin(0.2), abs=0.02)
    heights = level.world_from_camera[:, 2, 3]
    assert float(heights.max() - heights.min()) == pytest.approx(0.1, abs=0.15)
    assert "up is (" in caplog.text


def test_cameras_that_look_one_way_say_that_they_are_unsure(scan, caplog):
    poses = scan.world_from_camera.clone()
    poses[:, :3, :3] = poses[0, :3, :3]
    to_our_world(moved(replace(scan, world_from_camera=poses), Y_UP_FROM_Z_UP), BLIND)
    assert "up is +y (measured from the cameras, unsure, for they look one way)" in caplog.text


def test_cameras_turned_in_all_ways_ask_for_up(scan, caplog):
    poses = scan.world_from_camera.clone()
    poses[:, :3, :3] = torch.from_numpy(Rotation.random(12, rng=np.random.default_rng(0)).as_matrix())
    tumbling = replace(scan, world_from_camera=poses)
    assert to_our_world(tumbling, BLIND) is tumbling
    assert "up cannot be told; it is taken to be +z: give up=" in caplog.text


def test_scale_and_convention_are_applied(scan):
    millimetres = moved(scan, scale=1000.0, camera=OPENGL)
    ours = to_our_world(millimetres, replace(BLIND, scale=0.001, convention="opengl"))
    torch.testing.assert_close(ours.world_from_camera, scan.world_from_camera)
    ours = to_our_world(millimetres, replace(BLIND, scale=0.001), axes="opengl")
    torch.testing.assert_close(ours.world_from_camera, scan.world_from_camera)
    assert not np.allclose(
        to_our_world(millimetres, replace(BLIND, convention="opencv"), axes="opengl").world_from_camera[
            :, :3, :3
        ],
        scan.world_from_camera[:, :3, :3],
    )


def test_the_axis_alignment_moves_with_the_world(scan):
    aligned = replace(scan, axis_alignment=torch.from_numpy(np.diag([-1.0, -1.0, 1.0, 1.0])))
    aligned.axis_alignment[0, 3] = 5.0
    expected = aligned.axis_alignment @ aligned.world_from_camera
    turned = to_our_world(
        replace(
            aligned,
            world_from_camera=moved(scan, Y_UP_FROM_Z_UP).world_from_camera,
            axis_alignment=aligned.axis_alignment
            @ torch.block_diag(torch.from_numpy(Y_UP_FROM_Z_UP.T), torch.ones(1, 1)).double(),
        ),
        BLIND,
    )
    torch.testing.assert_close(turned.axis_alignment @ turned.world_from_camera, expected)


def test_three_frames_are_too_few_and_a_standstill_is_no_walk(scan, caplog):
    three = replace(scan, frame_id=scan.frame_id[:3], world_from_camera=scan.world_from_camera[:3])
    to_our_world(three, BLIND)
    assert "only 3 frames have an image and a pose" in caplog.text
    assert "give 20 or more" in caplog.text
    caplog.clear()
    to_our_world(moved(scan, scale=0.001), BLIND)
    assert "no walk through a room: give scale= (metres in a unit)" in caplog.text


def test_a_format_without_unit_says_what_one_metre_would_mean(scan, caplog):
    to_our_world(scan, BLIND, metric=False)
    assert (
        "does not tell the unit and one metre is supposed; cameras then rise and fall by 0.087 m"
        in caplog.text
    )
    caplog.clear()
    to_our_world(scan, replace(BLIND, scale=1.0), metric=False)
    assert "unit" not in caplog.text


def test_images_tell_opengl_axes_from_a_world_that_stands_on_its_head(furnished, caplog):
    # Both have up = -z by the cameras; only the images show which it is.
    opengl = to_our_world(moved(furnished, camera=OPENGL), WorldSettings())
    np.testing.assert_allclose(opengl.world_from_camera, furnished.world_from_camera.double(), atol=1e-6)
    assert "camera axes are opengl, not opencv as the format has it" in caplog.text
    assert "convention=opencv would keep them" in caplog.text
    caplog.clear()
    on_its_head = to_our_world(moved(furnished, np.diag([1.0, -1.0, -1.0])), WorldSettings())
    np.testing.assert_allclose(on_its_head.world_from_camera, furnished.world_from_camera.double(), atol=1e-6)
    assert "camera axes" not in caplog.text


def test_axes_that_were_asked_for_are_kept_and_contradicted(furnished, caplog):
    opengl = moved(furnished, camera=OPENGL)
    kept = to_our_world(opengl, WorldSettings(convention="opencv", up="-z"))
    expected = moved(opengl, np.diag([1.0, -1.0, -1.0])).world_from_camera
    np.testing.assert_allclose(kept.world_from_camera, expected, atol=1e-12)
    assert "OpenGL camera axes" in caplog.text
    assert "agree with the cameras as stored, 91% after the change; give convention=opengl" in caplog.text


def test_millimetres_are_said_and_not_mended(furnished, caplog):
    large = to_our_world(moved(furnished, scale=1000.0), WorldSettings())
    np.testing.assert_allclose(
        large.world_from_camera[:, :3, 3], 1000.0 * furnished.world_from_camera[:, :3, 3]
    )
    assert "positions in millimetres" in caplog.text
    assert "nothing is scaled: give scale=0.001 if that is right" in caplog.text
    caplog.clear()
    to_our_world(moved(furnished, scale=1000.0), WorldSettings(scale=0.001))
    assert "scale" not in caplog.text


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"up": "y"}, r"unknown up=y: choose one of auto, \+x"),
        ({"convention": "blender"}, "unknown convention=blender: choose one of auto, opencv, opengl"),
        ({"scale": 0.0}, r"scale=0\.0 is no positive number: give the metres in a unit"),
        ({"scale": float("nan")}, "no positive number"),
    ],
)
def test_unknown_settings(values, message):
    with pytest.raises(ConfigError, match=message):
        WorldSettings(**values)


UP = np.array([0.0, 0.0, 1.0])


def rolled(scan, quarters):
    """The same scan with the camera held rotated by quarter turns, clockwise seen from behind."""
    poses = scan.world_from_camera.clone()
    angle = torch.tensor(quarters * torch.pi / 2, dtype=torch.float64)
    roll = torch.eye(3, dtype=torch.float64)
    roll[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    poses[:, :3, :3] = poses[:, :3, :3] @ roll
    return replace(scan, world_from_camera=poses)


def test_an_upright_scan_is_left_alone(scan):
    assert rotate_upright(scan, UP) is scan


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_images_and_cameras_are_turned_together(scan, quarters):
    sideways = rolled(scan, quarters)
    upright = rotate_upright(sideways, UP)
    assert upright.image_size == ((64, 48) if quarters % 2 else (48, 64))
    tops = -upright.world_from_camera[:, 2, 1]
    assert float(tops.min()) > 0.9
    # A pixel of the stored image is found where its point of the world is seen in the turned one.
    images = [np.zeros((48, 64, 3), np.uint8) for _ in range(12)]
    pixel = (13, 50)
    images[4][pixel] = 255
    object.__setattr__(sideways, "images", type("", (), {"read": lambda self, i, *_: images[i]})())
    row, column = (int(value[0]) for value in np.nonzero(upright.read_color(4)[..., 0]))
    ray = torch.tensor([pixel[1] + 0.5, pixel[0] + 0.5, 1.0], dtype=torch.float64)
    pose = sideways.world_from_camera[4]
    point = pose[:3, :3] @ torch.linalg.inv(sideways.intrinsics[4]) @ (2 * ray) + pose[:3, 3]
    seen, depth = upright.cameras[4].project(point[None])
    assert seen[0].tolist() == pytest.approx([column + 0.5, row + 0.5])
    assert depth.item() == pytest.approx(2.0)


def test_sizes_are_those_of_the_turned_image(scan):
    upright = rotate_upright(rolled(scan, 1), UP)
    assert upright.read_color(3).shape == (64, 48, 3)
    assert upright.read_color(3, (32, 20)).shape == (32, 20, 3)
    assert upright.color_bytes(3) is None
    assert upright.path == scan.path


def test_images_that_turn_in_all_ways_are_left_alone(scan):
    poses = torch.cat([rolled(scan, q).world_from_camera[q::4] for q in range(4)])
    mixed = replace(scan, world_from_camera=poses)
    assert rotate_upright(mixed, UP) is mixed


DISTANCES = np.random.default_rng(0).uniform(1, 4, 200)


@pytest.mark.parametrize(
    ("factor", "cause", "metres"),
    [(100, "positions in centimetres", 0.01), (1000, "positions in millimetres", 0.001)],
)
@pytest.mark.parametrize("with_maps", [False, True])
def test_other_units_are_named(factor, cause, metres, with_maps):
    measured = np.where(np.arange(200) % 3 > 0, DISTANCES * 1.1, np.nan) if with_maps else None
    scale, finding = check_unit(DISTANCES * factor, measured)
    assert scale == metres
    assert (finding.state, finding.cause) == ("fault", cause)
    assert finding.confidence == ("certain" if with_maps else "likely")
    assert f"{metres}" in finding.fix


def test_feet_need_depth_maps():
    assert check_unit(DISTANCES * 3.2808, None)[1].state == "ok"
    scale, finding = check_unit(DISTANCES * 3.2808, DISTANCES)
    assert finding.cause == "positions in feet"
    assert scale == 0.3048


def test_a_scale_that_no_unit_explains_is_guessed_from_the_size_of_rooms():
    scale, finding = check_unit(DISTANCES * 1e9, None)
    assert finding.cause == "positions in no known unit"
    assert 1 < np.median(DISTANCES) * 1e9 * scale < 5


def test_an_arbitrary_scale_is_measured():
    scale, finding = check_unit(DISTANCES * 1.7, DISTANCES)
    assert finding.cause == "positions in no known unit"
    assert scale == pytest.approx(1 / 1.7)


def test_metres_are_right_and_few_points_tell_nothing():
    metres, finding = check_unit(DISTANCES, None)
    assert (metres, finding.state, finding.cause, finding.fix) == (1.0, "ok", "", "")
    assert f"{np.median(DISTANCES):.3g} units away" in finding.text
    metres, finding = check_unit(DISTANCES, DISTANCES * 1.15)
    assert (metres, finding.state) == (1.0, "ok")
    assert "times 1.15 are those of the depth maps (200 points)" in finding.text
    metres, finding = check_unit(DISTANCES[:10] * 1000, None)
    assert (metres, finding.state) == (1.0, "unknown")


AXES = {"+y": (0, 1, 0), "-y": (0, -1, 0), "+x": (1, 0, 0), "-x": (-1, 0, 0), "-z": (0, 0, -1)}


@pytest.mark.parametrize("name", AXES)
def test_another_up_is_named_and_mended(walk, name):
    turn = rotation_to_z(np.array(AXES[name], dtype=float))
    np.testing.assert_allclose(turn @ AXES[name], [0, 0, 1], atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    lying = walk.poses.copy()
    lying[:, :3] = turn.T @ lying[:, :3]
    found, finding = check_up(lying)
    np.testing.assert_array_equal(found, turn)
    assert (finding.state, finding.cause, finding.confidence) == ("fault", f"wrong up ({name})", "certain")
    assert str(turn.astype(int).tolist()) in finding.fix


def test_a_level_walk_is_right_and_a_leaning_one_is_noted(walk):
    assert check_up(walk.poses)[1].state == "ok"
    lean = np.radians(20)
    turn = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
    leaning = walk.poses.copy()
    leaning[:, :3] = turn @ leaning[:, :3]
    turn, finding = check_up(leaning)
    assert turn is None
    assert finding.state == "note"
    assert "20°" in finding.text


def test_one_way_of_looking_tells_up_by_the_tops_of_the_images(walk):
    still = np.tile(walk.poses[:1], (5, 1, 1))
    turn, finding = check_up(still)
    assert turn is None
    assert finding.state == "ok"
    still[:, :3] = np.diag([1.0, -1.0, -1.0]) @ still[:, :3]
    assert check_up(still)[1].confidence == "likely"
    down = np.radians(40)
    pitch = np.array([[1, 0, 0], [0, np.cos(down), np.sin(down)], [0, -np.sin(down), np.cos(down)]])
    looks_down = np.tile(walk.poses[:1], (5, 1, 1))
    looks_down[:, :3, :3] = looks_down[:, :3, :3] @ pitch
    assert check_up(looks_down)[1].state == "ok"


def test_a_world_that_leans_far_is_levelled(walk):
    lean = np.radians(60)
    turn = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
    leaning = walk.poses.copy()
    leaning[:, :3] = turn @ leaning[:, :3]
    found, finding = check_up(leaning)
    assert finding.cause == "world not level"
    np.testing.assert_allclose(found, turn.T, atol=0.05)
    assert str(found.round(4).tolist()) in finding.fix
