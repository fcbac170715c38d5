# SPDX-License-Identifier: Apache-2.0
"""Worlds with other axes and units: found, given, or said; and images that show what the poses hide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from raytran.capture.colmap import read_colmap
from raytran.capture.imported import from_files
from raytran.capture.orient import WorldSettings, to_our_world
from raytran.data.scannet.scan import read_scan
from raytran.errors import ConfigError

from .forms import OPENGL, write_colmap

BLIND = WorldSettings(check=False)
Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.fixture
def scan(walk):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    return from_files(read_colmap(walk.folder))


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
