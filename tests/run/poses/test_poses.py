# SPDX-License-Identifier: Apache-2.0
"""The command poses: from a film to a scan that opens upright and in metres, and what it says of mistakes."""

from __future__ import annotations

import json
import logging
import shutil
import sys

import numpy as np
import pytest

from raytran.capture.lens import load_pycolmap
from raytran.capture.open import open_scene
from raytran.errors import ConfigError, DataError
from raytran.run.entry import compose
from raytran.run.poses.poses import poses

from ...capture.poses.box_room import CAMERA_HEIGHT, BoxRoom, aligned

pytest.importorskip("pycolmap", reason="pycolmap, which finds the cameras, is not installed")


@pytest.fixture(scope="module")
def room():
    return BoxRoom.make((120, 160))


@pytest.fixture(scope="module")
def film(room, tmp_path_factory):
    """A folder of images, walked around a room."""
    folder = tmp_path_factory.mktemp("film")
    for number, pose in enumerate(room.walk(20, turn=1.7 * np.pi)):
        room.draw(pose).save(folder / f"{number}.jpg", quality=95)
    return folder


@pytest.fixture(scope="module")
def scan(film, tmp_path_factory):
    """Where its scan was written."""
    output = tmp_path_factory.mktemp("scan") / "walk"
    poses(compose("poses", [f"video={film}", f"output={output}", f"camera_height={CAMERA_HEIGHT}"]))
    return output


def again(film, scan, *words):
    poses(compose("poses", [f"video={film}", f"output={scan}", *words]))
    return json.loads((scan / "transforms.json").read_text())


def test_the_scan_opens_upright_and_in_metres(film, scan, room, caplog):
    with caplog.at_level(logging.INFO), open_scene(scan) as opened:
        found = opened.world_from_camera.double().numpy()
        numbers = [int(name) for name in opened.frame_id]
    assert "up is +z (as the format has it)" in caplog.text
    assert "does not tell the unit" not in caplog.text
    assert len(numbers) >= 18
    true = room.walk(20, turn=1.7 * np.pi)[numbers]
    fitted, scale = aligned(found, true)
    assert np.linalg.norm(fitted[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.05
    assert scale == pytest.approx(1.0, abs=0.04)
    # The floor is at 0, where the room has it.
    assert found[:, 2, 3].mean() == pytest.approx(CAMERA_HEIGHT, abs=0.01)
    # Up: what turns found cameras into true ones is a turn about +z.
    turn = fitted[0, :3, :3] @ found[0, :3, :3].T
    assert np.degrees(np.arccos(turn[2, 2])) < 1.5


def test_another_measure_takes_the_cameras_that_are_there(film, scan, room, caplog):
    before = again(film, scan, f"camera_height={CAMERA_HEIGHT}")
    with caplog.at_level(logging.INFO):
        double = again(film, scan, f"camera_height={2 * CAMERA_HEIGHT}")
    assert "finding features" not in caplog.text
    assert "placing the cameras" not in caplog.text
    first, second = (
        np.array([frame["transform_matrix"] for frame in content["frames"]]) for content in (before, double)
    )
    np.testing.assert_allclose(second[:, :3, 3], 2 * first[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose(second[:, :3, :3], first[:, :3, :3], atol=1e-6)


def test_without_a_measure_the_unit_is_supposed_and_not_promised(film, scan, caplog):
    with caplog.at_level(logging.WARNING):
        content = again(film, scan)
    assert "the unit is supposed, by a phone 1.5 m above the floor: measure that" in caplog.text
    assert content["raytran_world"]["unit"] is None
    assert content["raytran_world"]["up"] == "+z"
    with caplog.at_level(logging.WARNING), open_scene(scan):
        pass
    assert "this format does not tell the unit" in caplog.text


def test_a_marked_distance_tells_the_unit(film, scan, room):
    """Two points of a wall, seen in some frames."""
    content = again(film, scan, "scale=1")
    stems = [frame["file_path"][7:-4] for frame in content["frames"]]
    ends = np.array([[0.0, 1.0, 0.5], [0.0, 2.5, 1.3]])
    marks = []
    for stem in stems:
        pose = room.walk(20, turn=1.7 * np.pi)[int(stem)]
        points = (ends - pose[:3, 3]) @ pose[:3, :3]
        pixels = points[:, :2] / points[:, 2:] * room.focal + [80, 60]
        if (points[:, 2] > 0).all() and ((pixels > 0) & (pixels < [160, 120])).all():
            marks.append([stem, *pixels.ravel().round(1).tolist()])
    assert len(marks) >= 2
    typed = str(marks).replace("'", "").replace(" ", "")
    measured = again(film, scan, "distance=1.7", f"marks={typed}")["raytran_world"]["scale"]
    by_height = again(film, scan, f"camera_height={CAMERA_HEIGHT}")["raytran_world"]["scale"]
    assert measured == pytest.approx(by_height, rel=0.05)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["camera_height=1.5", "scale=2"], "camera_height= and scale= tell the unit twice"),
        (["distance=2"], "distance= and marks= belong together"),
        (["camera_height=0"], "camera_height=0 is no length"),
        (["matching=all"], "unknown matching=all: choose one of auto, sequential, exhaustive"),
        (["frames=5"], "frames=5 is too few"),
    ],
)
def test_settings_that_make_no_sense(film, tmp_path, words, message):
    with pytest.raises(ConfigError, match=message):
        poses(compose("poses", [f"video={film}", f"output={tmp_path / 'out'}", *words]))
    assert not (tmp_path / "out").exists()


def test_pycolmap_is_asked_for(film, tmp_path, monkeypatch):
    load_pycolmap.cache_clear()
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ConfigError, match=r"cameras of a film are found by pycolmap, .*'raytran\[colmap\]'"):
        poses(compose("poses", [f"video={film}", f"output={tmp_path / 'out'}"]))
    load_pycolmap.cache_clear()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", ["{}", '{"frames": [0, 1.5]}', '{"frames": [0, 99]}', "{"])
def test_a_damaged_list_of_frames(film, scan, tmp_path, content):
    (tmp_path / "out" / "work").mkdir(parents=True)
    shutil.copy(scan / "work" / "film.json", tmp_path / "out" / "work")
    (tmp_path / "out" / "work" / "frames.json").write_text(content)
    with pytest.raises(DataError, match=r"frames\.json"):
        poses(compose("poses", [f"video={film}", f"output={tmp_path / 'out'}"]))


def test_folders_that_are_of_something_else(film, scan, tmp_path):
    (tmp_path / "mine.txt").touch()
    with pytest.raises(ConfigError, match="holds something else: choose a folder that does not exist"):
        poses(compose("poses", [f"video={film}", f"output={tmp_path}"]))
    with pytest.raises(ConfigError, match="was begun with another frames: give another output="):
        again(film, scan, "frames=10")


def test_a_film_that_is_too_short(film, tmp_path, room):
    folder = tmp_path / "short"
    folder.mkdir()
    for number, pose in enumerate(room.walk(4)):
        room.draw(pose).save(folder / f"{number}.jpg")
    with pytest.raises(DataError, match="has only 4 frames to match: film for half a minute"):
        poses(compose("poses", [f"video={folder}", f"output={tmp_path / 'out'}"]))
