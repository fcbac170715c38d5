# SPDX-License-Identifier: Apache-2.0
"""Axes, up and unit: measured, checked, corrected or reported; and images that were stored sideways."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from raytran.capture.colmap import read_colmap
from raytran.capture.exif import tags_of
from raytran.capture.open import open_scene
from raytran.capture.orientation import (
    WorldSettings,
    check_unit,
    check_up,
    measured_up,
    rotate_upright,
    rotation_to_z,
    to_our_world,
)
from raytran.capture.recording import open_recording
from raytran.data.images import resize, turned_image
from raytran.data.scannet.scan import read_scan
from raytran.errors import ConfigError

from .forms import OPENGL, Walk, write_colmap, write_transforms, write_tum

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
        ({"up": "up"}, r"unknown up=up: .* or give a direction such as up=0\.1,0\.2,0\.97"),
        ({"up": "1,2"}, "unknown up=1,2: choose"),
        ({"up": "1,2,3,4"}, "unknown up=1,2,3,4: choose"),
        ({"up": "1,2,z"}, "unknown up=1,2,z: choose"),
        ({"up": [1.0, "x", 2.0]}, "unknown up="),
        ({"up": 3}, "unknown up=3: choose"),
        ({"up": None}, "unknown up=None: choose"),
        ({"up": "9" * 5000}, "unknown up=9{60}: choose"),
        ({"up": [0.0, 0.0, 0.0]}, "is no direction: give three finite numbers that are not all zero"),
        ({"up": "nan,0,1"}, "up=nan,0,1 is no direction"),
        ({"up": [float("inf"), 0.0, 1.0]}, "is no direction"),
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


@pytest.mark.parametrize("quarters", [(0, 1), (0, 2), (1, 3), (2, 3)])
def test_a_camera_that_was_turned_on_the_way_has_each_image_turned(scan, quarters):
    """Five frames held one way, seven another: all are upright, and show what the stored ones show."""
    first, second = (rolled(scan, q).world_from_camera for q in quarters)
    mixed = replace(scan, world_from_camera=torch.cat([first[:5], second[5:]]))
    images = [np.full((48, 64, 3), 40, np.uint8) for _ in range(12)]
    for image in images:
        image[10:20, 40:54] = 250

    def read(self, index, size, stored):
        return images[index] if size is None else resize(images[index], size)

    object.__setattr__(mixed, "images", type("", (), {"tags": None, "read": read})())
    upright = rotate_upright(mixed, UP)
    assert upright.image_size == ((64, 48) if quarters[1] % 2 else (48, 64))
    assert float((-upright.world_from_camera[:, 2, 1]).min()) > 0.9
    for n in (2, 9):
        shown = upright.read_color(n)
        assert shown.shape[:2] == upright.image_size
        row, column = (value.mean() + 0.5 for value in np.nonzero(shown[..., 0] > 200))
        ray = torch.tensor([47.0, 15.0, 1.0], dtype=torch.float64)
        pose = mixed.world_from_camera[n]
        point = pose[:3, :3] @ torch.linalg.inv(mixed.intrinsics[n]) @ (2 * ray) + pose[:3, 3]
        seen, depth = upright.cameras[n].project(point[None])
        assert seen[0].tolist() == pytest.approx([column, row], abs=0.6)
        assert depth.item() == pytest.approx(2.0)
        smaller = tuple(side // 2 for side in upright.image_size)
        assert upright.read_color(n, smaller).shape[:2] == smaller
    is_filled = (quarters[0] - quarters[1]) % 2
    assert (upright.picture is not None) == is_filled
    if is_filled:
        left, top, right, bottom = upright.picture[2].tolist()
        outside = upright.read_color(2)
        outside[round(top) : round(bottom), round(left) : round(right)] = outside[0, 0]
        assert (outside == outside[0, 0]).all()
        assert upright.picture[9].tolist() == [0, 0, upright.image_size[1], upright.image_size[0]]


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


LOOK_DOWN = 25.0
"""Degrees by which the cameras of the tests below look down, as people do who film a room."""


def level_walk(n=24, turn_deg=300.0, down_deg=LOOK_DOWN, wobble_deg=2.0):
    """Cameras ``(n, 4, 4)`` held upright that turn about while they go; +z is up."""
    generator = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (n, 1, 1))
    for i, pose in enumerate(poses):
        yaw = np.radians(turn_deg) * i / (n - 1)
        pitch = -np.radians(down_deg + 8 * np.sin(i))
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, :3] = (
            pose[:3, :3] @ Rotation.from_euler("z", wobble_deg * generator.normal(), degrees=True).as_matrix()
        )
        pose[:3, 3] = [0.3 * i, 0.5 * np.cos(i), 1.5 + 0.05 * np.sin(2 * i)]
    return poses


QUARTER = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Camera axes of an image → those of the image that was turned by 90° clockwise."""

SIDE_OF_TAG = {1: 0, 3: 2, 6: 3, 8: 1}
TURN_OF_SIDE = {0: 1, 1: 6, 2: 3, 3: 8}
"""Side of the stored image that is up → EXIF orientation by which an upright image is turned into it."""


def lying(poses, sides):
    """The cameras of images that were stored so that up is at the given sides: top, right, bottom, left."""
    stored = poses.copy()
    for pose, side in zip(stored, np.broadcast_to(sides, len(poses)), strict=True):
        pose[:3, :3] = pose[:3, :3] @ np.linalg.matrix_power(QUARTER, int(side))
    return stored


def elsewhere(poses, seed=5):
    """The cameras in a world that leans in all ways, and up there."""
    world = np.eye(4)
    world[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    return world @ poses, world[:3, 2]


def degrees_between(a, b):
    return float(np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1))))


@pytest.mark.parametrize("side", range(4))
@pytest.mark.parametrize("seed", range(3))
def test_cameras_on_any_side_tell_up_if_files_say_which_it_is(side, seed):
    poses, up = elsewhere(lying(level_walk(), side), seed)
    found = measured_up(poses, sides=[side] * len(poses))
    assert degrees_between(found.direction, up) < 2
    assert found.is_level
    assert found.is_side_known


@pytest.mark.parametrize("side", range(4))
def test_cameras_that_look_one_way_are_off_by_their_pitch_at_most(side):
    poses, up = elsewhere(lying(level_walk(turn_deg=15, down_deg=20), side))
    found = measured_up(poses, sides=[side] * len(poses))
    assert degrees_between(found.direction, up) < 22
    assert not found.is_level


@pytest.mark.parametrize("side", [1, 3])
def test_without_a_word_from_the_files_level_columns_and_looking_down_tell_up(side):
    poses, up = elsewhere(lying(level_walk(), side))
    found = measured_up(poses)
    assert degrees_between(found.direction, up) < 2
    assert found.is_level
    assert not found.is_side_known


def test_a_phone_that_was_turned_on_the_way_tells_up():
    sides = np.where(np.arange(24) < 11, 0, 3)
    poses, up = elsewhere(lying(level_walk(), sides))
    for told in (None, sides.tolist()):
        found = measured_up(poses, sides=told)
        assert degrees_between(found.direction, up) < 2
        assert found.is_level


def test_tags_that_were_left_when_pixels_were_turned_are_not_believed():
    poses, up = elsewhere(level_walk())
    assert degrees_between(measured_up(poses, sides=[3] * len(poses)).direction, up) < 2


def test_a_camera_that_nods_is_not_taken_for_one_on_its_side():
    poses = level_walk(turn_deg=10, down_deg=15)
    for i, pose in enumerate(poses):
        nod = Rotation.from_euler("x", 20 * np.sin(i), degrees=True).as_matrix()
        pose[:3, :3] = pose[:3, :3] @ nod
    poses, up = elsewhere(poses)
    found = measured_up(poses)
    assert degrees_between(found.direction, up) < 25
    assert not found.is_level


def picture(n, size=(48, 64)):
    """An image of its own for each frame whose four quarters differ."""
    quarters = np.array([[[200, 40, 40], [40, 200, 40]], [[40, 40, 200], [220, 220, 220]]]) - 3 * (n % 8)
    return np.kron(quarters, np.ones((size[0] // 2, size[1] // 2, 1))).astype(np.uint8)


def stored_walk(folder, poses, sides, *, with_tags=True, size=(48, 64)) -> Walk:
    """Write images as they are stored with up at the given sides, and return the walk with their cameras.

    Args:
        folder: for the images.
        poses: of the upright images.
        sides: at which up is in each stored one.
        with_tags: whether EXIF says it.
        size: ``(H, W)`` of the upright images.
    """
    (folder / "images").mkdir(parents=True)
    sides = np.broadcast_to(sides, len(poses))
    tag_of_side = {side: tag for tag, side in SIDE_OF_TAG.items()}
    for n, side in enumerate(sides):
        exif = Image.Exif()
        exif[0x0112] = tag_of_side[int(side)]
        pixels = turned_image(picture(n, size), TURN_OF_SIDE[int(side)])
        Image.fromarray(pixels).save(folder / "images" / f"{n}.png", **({"exif": exif} if with_tags else {}))
    height, width = size
    camera = (50.0, 51.0, width / 2 - 1, height / 2 + 1)
    for _ in range(int(sides[0])):
        camera = (camera[1], camera[0], height - camera[3], camera[2])
        height, width = width, height
    names = tuple(f"{n}.png" for n in range(len(poses)))
    return Walk(folder, names, lying(poses, sides), (height, width), camera)


def same_scan(scan, poses, *, tolerance=0.0, size=(48, 64)):
    """Assert that a scan has upright images, right cameras, and up within ``tolerance`` degrees of +z."""
    assert scan.image_size == size
    # A turn about +z is left open where the world was anywhere.
    relative = scan.world_from_camera[0, :3, :3].numpy() @ poses[0, :3, :3].T
    assert degrees_between(relative[:, 2], [0, 0, 1]) <= tolerance + 1e-4
    turned = relative @ poses[:, :3, :3]
    np.testing.assert_allclose(scan.world_from_camera[:, :3, :3].numpy(), turned, atol=1e-6)
    assert scan.intrinsics[0, 0, 2].item() == pytest.approx(size[1] / 2 - 1)
    assert scan.intrinsics[0, 1, 2].item() == pytest.approx(size[0] / 2 + 1)
    for n in (0, len(poses) // 2):
        assert np.abs(scan.read_color(n).astype(int) - picture(n, size)).max() <= 2


@pytest.mark.parametrize("side", [1, 2, 3])
@pytest.mark.parametrize("write", ["colmap", "nerfstudio"])
def test_photographs_on_any_side_come_upright_from_programs_that_read_them_as_stored(tmp_path, side, write):
    poses = level_walk()
    walk = stored_walk(tmp_path / "walk", poses, side)
    walk = replace(walk, poses=elsewhere(walk.poses)[0])
    if write == "colmap":
        write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    else:
        write_transforms(walk)
    with open_scene(walk.folder, settings=BLIND) as scan:
        same_scan(scan, poses, tolerance=2)


def test_photographs_on_their_side_without_a_tag_come_upright_and_say_that_it_is_a_guess(tmp_path, caplog):
    poses = level_walk()
    walk = stored_walk(tmp_path / "walk", poses, 3, with_tags=False)
    write_colmap(replace(walk, poses=elsewhere(walk.poses)[0]), walk.folder / "sparse" / "0", binary=True)
    with open_scene(walk.folder, settings=BLIND) as scan:
        same_scan(scan, poses, tolerance=2)
    assert "unsure which side of the images it is" in caplog.text


@pytest.mark.parametrize("side", [1, 3])
def test_a_tum_track_of_shown_or_of_stored_pictures_is_told_by_the_aspect_of_its_intrinsics(
    tmp_path, caplog, side
):
    caplog.set_level("INFO")
    poses = level_walk()
    walk = stored_walk(tmp_path / "walk", poses, side)
    write_tum(walk, tmp_path / "stored", np.arange(24) / 10)
    with open_scene(tmp_path / "stored", settings=BLIND) as scan:
        same_scan(scan, poses, tolerance=2)
    assert "those of the images as stored, as their intrinsics have it" in caplog.text
    shown = replace(walk, poses=poses, camera=(50.0, 51.0, 31.0, 25.0))
    write_tum(shown, tmp_path / "shown", np.arange(24) / 10)
    with open_scene(tmp_path / "shown", settings=BLIND) as scan:
        same_scan(scan, poses)
        assert scan.color_bytes(0) is None
    assert "those of the images as shown, as their intrinsics have it" in caplog.text


@pytest.mark.parametrize(("side", "size"), [(2, (48, 64)), (1, (48, 48)), (3, (48, 48)), (2, (48, 48))])
def test_where_nothing_tells_a_tum_track_is_of_shown_pictures_as_opencv_reads_them(
    tmp_path, caplog, side, size
):
    caplog.set_level("INFO")
    poses = level_walk()
    walk = stored_walk(tmp_path / "walk", poses, side, size=size)
    camera = (50.0, 51.0, size[1] / 2 - 1, size[0] / 2 + 1)
    write_tum(replace(walk, poses=poses, camera=camera), tmp_path / "tum", np.arange(24) / 10)
    with open_scene(tmp_path / "tum", settings=BLIND) as scan:
        same_scan(scan, poses, size=size)
        assert scan.read_color(3, (24, 20)).shape == (24, 20, 3)
    assert "24 turned by" in caplog.text
    assert "those of the images as shown, as programs of its format do" in caplog.text
    # If up is known and the poses have it at the side of which the file speaks, they are of stored pictures.
    write_tum(walk, tmp_path / "stored", np.arange(24) / 10)
    with open_scene(tmp_path / "stored", settings=replace(BLIND, up="+z")) as scan:
        same_scan(scan, poses, size=size)
    assert "as stored, as up in their poses has it" in caplog.text


def test_some_pictures_on_their_head_are_each_turned_by_their_tag(tmp_path):
    poses = level_walk()
    sides = np.where(np.arange(24) % 3 == 0, 2, 0)
    walk = stored_walk(tmp_path / "walk", poses, sides)
    shown = replace(walk, poses=poses, camera=(50.0, 51.0, 31.0, 25.0))
    write_tum(shown, tmp_path / "tum", np.arange(24) / 10)
    with open_scene(tmp_path / "tum", settings=BLIND) as scan:
        same_scan(scan, poses)
        assert np.abs(scan.read_color(1).astype(int) - picture(1)).max() <= 2
        assert scan.color_bytes(1) is not None
        assert tags_of(scan).sides == (0,) * 24


def write_scannet(walk: Walk, folder, poses=None):
    """Write a walk in the form of ScanNet's C++ tool, as 3RScan has it."""
    folder.mkdir(parents=True)
    fx, fy, cx, cy = walk.camera
    for n, (name, pose) in enumerate(zip(walk.names, walk.poses if poses is None else poses, strict=True)):
        (folder / f"frame-{n:06d}.color.jpg").write_bytes((walk.folder / "images" / name).read_bytes())
        np.savetxt(folder / f"frame-{n:06d}.pose.txt", pose)
    matrix = f"{fx} 0 {cx} 0 0 {fy} {cy} 0 0 0 1 0 0 0 0 1"
    height, width = walk.image_size
    facts = f"m_colorWidth = {width}\nm_colorHeight = {height}\nm_calibrationColorIntrinsic = {matrix}\n"
    (folder / "_info.txt").write_text(facts)
    return folder


@pytest.mark.parametrize("side", [0, 1, 2, 3])
@pytest.mark.parametrize(("turn_deg", "down_deg"), [(300, 25), (20, 25), (20, 57), (0, 45)])
def test_a_world_that_is_promised_is_kept_and_its_pictures_are_turned(
    tmp_path, caplog, side, turn_deg, down_deg
):
    """3RScan has pictures on their side; cameras that look one way and down tilt what they tell of up."""
    poses = level_walk(turn_deg=turn_deg, down_deg=down_deg)
    walk = stored_walk(tmp_path / "walk", poses, side, with_tags=False)
    with open_scene(write_scannet(walk, tmp_path / "scan" / "sequence").parent, settings=BLIND) as scan:
        np.testing.assert_allclose(scan.world_from_camera.numpy(), poses, atol=1e-9)
        same_scan(scan, poses)
    assert "up" not in caplog.text


@pytest.mark.parametrize("side", [1, 2, 3])
def test_scannets_form_may_have_intrinsics_of_shown_pictures(tmp_path, side):
    poses = level_walk()
    walk = stored_walk(tmp_path / "walk", poses, side)
    shown = replace(walk, camera=(50.0, 51.0, 31.0, 25.0), image_size=(48, 64))
    folder = write_scannet(shown, tmp_path / "scan", poses)
    with open_scene(folder, settings=BLIND) as scan:
        same_scan(scan, poses)
    folder = write_scannet(walk, tmp_path / "stored")
    with open_scene(folder, settings=BLIND) as scan:
        same_scan(scan, poses)


@pytest.mark.parametrize("form", ["colmap", "scannet"])
def test_a_phone_that_was_turned_on_the_way_gives_upright_pictures_of_a_level_world(tmp_path, form):
    """Stored by the sensor in landscape; the first ten were taken in landscape, the others upright."""
    poses = level_walk()
    landscape = np.arange(24) < 10
    walk = stored_walk(tmp_path / "walk", poses, 0, with_tags=form == "colmap")
    upright = stored_walk(tmp_path / "upright", poses, 3, with_tags=form == "colmap", size=(64, 48))
    for n in np.flatnonzero(~landscape):
        (walk.folder / "images" / f"{n}.png").write_bytes(
            (upright.folder / "images" / f"{n}.png").read_bytes()
        )
    walk = replace(walk, poses=np.where(landscape[:, None, None], poses, upright.poses))
    if form == "colmap":
        write_colmap(replace(walk, poses=elsewhere(walk.poses)[0]), walk.folder / "sparse" / "0", binary=True)
        folder = walk.folder
    else:
        folder = write_scannet(walk, tmp_path / "scan")
    with open_scene(folder, settings=BLIND) as scan:
        assert scan.image_size == (64, 48)
        relative = scan.world_from_camera[0, :3, :3].numpy() @ poses[0, :3, :3].T
        assert degrees_between(relative[:, 2], [0, 0, 1]) < 2
        turned = relative @ poses[:, :3, :3]
        np.testing.assert_allclose(scan.world_from_camera[:, :3, :3].numpy(), turned, atol=1e-6)
        assert np.abs(scan.read_color(20).astype(int) - picture(20, (64, 48))).max() <= 2
        assert scan.picture[20].tolist() == [0, 0, 48, 64]
        # A landscape picture lies in the middle, three quarters as large; and so are its cameras.
        assert scan.picture[3].tolist() == [0, 14, 48, 50]
        inner = scan.read_color(3)[14:50].astype(int)
        assert np.abs(inner - resize(picture(3), (36, 48))).max() <= 2
        np.testing.assert_allclose(scan.intrinsics[3, :2, 2], [31 * 0.75, 25 * 0.75 + 14])
        np.testing.assert_allclose(scan.intrinsics[3].diagonal(), [50 * 0.75, 51 * 0.75, 1])


def test_a_world_that_contradicts_its_promise_is_reported_and_mended_by_a_setting(tmp_path, caplog):
    poses = level_walk()
    y_up = poses.copy()
    y_up[:, :3] = Y_UP_FROM_Z_UP @ y_up[:, :3]
    walk = stored_walk(tmp_path / "walk", poses, 0, with_tags=False)
    folder = write_scannet(walk, tmp_path / "scan", y_up)
    with open_scene(folder, settings=BLIND) as scan:
        np.testing.assert_allclose(scan.world_from_camera.numpy(), y_up, atol=1e-9)
    assert "up is +y by the cameras, not +z as the format has it, which is kept: give up=+y if" in caplog.text
    with open_scene(folder, settings=replace(BLIND, up="+y")) as scan:
        same_scan(scan, poses)


def test_a_leaning_world_that_contradicts_its_promise_names_a_vector_that_mends_it(tmp_path, caplog):
    poses = level_walk(wobble_deg=0)
    leaning, up = elsewhere(poses, seed=0)
    walk = stored_walk(tmp_path / "walk", poses, 0, with_tags=False)
    folder = write_scannet(walk, tmp_path / "scan", leaning)
    open_scene(folder, settings=BLIND).close()
    asked = caplog.text.partition("give up=")[2].split()[0]
    assert degrees_between(WorldSettings(up=asked).direction, up) < 1
    with open_scene(folder, settings=replace(BLIND, up=asked)) as scan:
        same_scan(scan, poses, tolerance=1)


@pytest.mark.parametrize(("down_deg", "turn_deg"), [(20, 10), (45, 10), (45, 0)])
def test_a_track_whose_cameras_look_one_way_and_down_keeps_its_level_world(
    tmp_path, caplog, down_deg, turn_deg
):
    poses = level_walk(down_deg=down_deg, turn_deg=turn_deg)
    walk = replace(stored_walk(tmp_path / "walk", poses, 0, with_tags=False), poses=poses)
    write_tum(walk, tmp_path / "tum", np.arange(24) / 10)
    caplog.set_level("INFO")
    with open_scene(tmp_path / "tum", settings=BLIND) as scan:
        np.testing.assert_allclose(scan.world_from_camera.numpy(), poses, atol=1e-6)
    assert "up is +z (measured from the cameras, unsure, for they look one way)" in caplog.text


@pytest.mark.parametrize("side", [1, 3])
def test_record3d_in_landscape_comes_upright(tmp_path, side):
    """Before version 1.10 it stored all in portrait, in the world of the first camera."""
    poses = level_walk()
    walk = stored_walk(tmp_path / "walk", poses, side, with_tags=False)
    (walk.folder / "images").rename(walk.folder / "rgb")
    stored = np.linalg.inv(walk.poses[0]) @ walk.poses @ OPENGL
    quaternions = Rotation.from_matrix(stored[:, :3, :3]).as_quat()
    fx, fy, cx, cy = walk.camera
    facts = {
        "w": walk.image_size[1],
        "h": walk.image_size[0],
        "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1],
        "poses": np.concatenate([quaternions, stored[:, :3, 3]], axis=1).tolist(),
    }
    (walk.folder / "metadata.json").write_text(json.dumps(facts))
    with open_scene(walk.folder, settings=BLIND) as scan:
        same_scan(scan, poses, tolerance=2)


@pytest.mark.parametrize("given", ["list", "text", "brackets", "long", "tuple", "array"])
def test_up_may_be_any_direction(tmp_path, given, caplog):
    poses = level_walk()
    leaning, up = elsewhere(lying(poses, 1))
    walk = stored_walk(tmp_path / "walk", poses, 1)
    write_colmap(replace(walk, poses=leaning), walk.folder / "sparse" / "0", binary=True)
    x, y, z = up.tolist()
    forms = {"list": [x, y, z], "text": f"{x},{y},{z}", "brackets": f"[{x}, {y}, {z}]", "tuple": (x, y, z)}
    forms["long"] = [1e300 * x, 1e300 * y, 1e300 * z]
    forms["array"] = up
    with open_scene(walk.folder, settings=replace(BLIND, up=forms[given])) as scan:
        same_scan(scan, poses)
    assert "(as up= says)" in caplog.text


def test_a_direction_along_an_axis_is_that_axis():
    for axis in np.eye(3):
        assert WorldSettings(up=(3 * axis).tolist()).direction.tolist() == axis.tolist()
    assert WorldSettings(up="0,0,-2").direction.tolist() == [0.0, 0.0, -1.0]


def turned_in_files(scan, folder, turn, *, with_tags):
    """Write a TUM folder with a scan's poses, and its images turned back by an EXIF orientation."""
    undo = {3: 3, 6: 8, 8: 6}[turn]
    exif = Image.Exif()
    exif[0x0112] = turn
    images = folder.parent / f"{folder.name}_images" / "images"
    images.mkdir(parents=True)
    for n in range(len(scan)):
        pixels = Image.fromarray(turned_image(scan.read_color(n), undo))
        pixels.save(images / f"{n}.png", **({"exif": exif} if with_tags else {}))
    fx, fy, cx, cy = (float(scan.intrinsics[0, i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    names = tuple(f"{n}.png" for n in range(len(scan)))
    walk = Walk(
        images.parent, names, scan.world_from_camera.double().numpy(), scan.image_size, (fx, fy, cx, cy)
    )
    write_tum(walk, folder, np.arange(len(scan)) / 10)
    return folder


@pytest.mark.parametrize(("side", "how"), [(0, "shown"), (2, "stored")])
def test_the_images_tell_whether_poses_are_of_shown_or_of_stored_pictures(
    furnished, tmp_path, caplog, side, how
):
    """The same pictures with the poses of a program that honours their tag, and of one that ignores it."""
    caplog.set_level("INFO")
    poses = furnished.world_from_camera.double().numpy()
    tracked = replace(furnished, world_from_camera=torch.from_numpy(lying(poses, side)))
    with open_scene(turned_in_files(tracked, tmp_path / "tum", 3, with_tags=True)) as scan:
        np.testing.assert_allclose(scan.world_from_camera, poses, atol=1e-6)
        np.testing.assert_array_equal(scan.read_color(3), furnished.read_color(3))
    assert f"those of the images as {how}, as the images agree with the poses" in caplog.text
    assert "camera axes" not in caplog.text


def test_a_half_turn_that_no_file_tells_is_found_in_the_images_and_mended(furnished, tmp_path, caplog):
    """A camera that hung upside down, and poses of a program that turned its pictures; all tags are lost."""
    poses = furnished.world_from_camera.double().numpy()
    with open_scene(turned_in_files(furnished, tmp_path / "head", 3, with_tags=False)) as scan:
        np.testing.assert_allclose(scan.world_from_camera, poses, atol=1e-6)
        np.testing.assert_array_equal(scan.read_color(3), furnished.read_color(3))
    assert "camera axes are turned by 180° about where the camera looks, not opencv" in caplog.text
    assert "convention=opencv would keep them" in caplog.text


def test_pytorch3d_axes_are_mended(furnished, caplog):
    """Upright pictures, and cameras whose x axis points to the left and y axis to the top."""
    other = moved(furnished, camera=np.diag([-1.0, -1.0, 1.0, 1.0]))
    scan = to_our_world(other, WorldSettings())
    np.testing.assert_allclose(scan.world_from_camera, furnished.world_from_camera.double(), atol=1e-6)
    np.testing.assert_array_equal(scan.read_color(3), furnished.read_color(3))
    caplog.clear()
    kept = to_our_world(other, WorldSettings(convention="opencv"))
    assert "PyTorch3D camera axes" in caplog.text
    assert kept is not other


@pytest.mark.parametrize("side", [1, 3])
def test_the_doctor_says_that_pictures_lie_on_their_side_and_leaves_the_world(side):
    turn, finding = check_up(lying(level_walk(), side))
    assert turn is None
    assert finding.state == "note"
    assert "0° from +z; most images lie on their side" in finding.text or "1° from +z; most" in finding.text


def test_the_doctor_turns_no_world_by_cameras_that_look_one_way_and_steeply_down():
    for down in (40, 57, 70):
        turn, finding = check_up(level_walk(turn_deg=10, down_deg=down))
        assert turn is None
        assert finding.state == "ok"
    turn, finding = check_up(lying(level_walk(turn_deg=10), 3))
    assert turn is None
    assert finding.state == "note"
    assert "their images may lie on their side, or the world" in finding.text
