# SPDX-License-Identifier: Apache-2.0
"""``raytran prepare check=DIR``."""

from __future__ import annotations

import logging
import shutil

import numpy as np
import pytest

from raytran.capture.doctor.examine import Examination
from raytran.errors import ConfigError, DataError
from raytran.rooms.generate import generate_rooms
from raytran.run.entry import compose
from raytran.run.prepare.check import check_folder
from raytran.run.prepare.prepare import prepare


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    root = tmp_path_factory.mktemp("check") / "rooms"
    generate_rooms(
        root,
        num_train=2,
        num_val=1,
        seed=3,
        frames=12,
        image_size=(120, 160),
        min_objects=3,
        max_objects=5,
        room_size=((3.0, 3.5), (3.0, 3.5)),
        processes=1,
        progress=False,
    )
    return root


def run(*overrides):
    return prepare(compose("prepare", list(overrides)))


def test_right_rooms_end_well_and_leave_a_page(rooms, tmp_path, caplog, capsys):
    with caplog.at_level(logging.INFO):
        assert run(f"check={rooms}", f"output={tmp_path / 'out'}", "checks=1")
    page = tmp_path / "out" / "doctor.html"
    assert page.is_file()
    assert "nothing to mend" in caplog.text
    assert str(page) in caplog.text
    assert capsys.readouterr().out.count("right") == 1


def test_a_spoiled_scan_ends_with_one_and_is_named(rooms, tmp_path, capsys):
    copy = shutil.copytree(rooms / "scannet", tmp_path / "scannet")
    for path in (copy / "scans" / "scene0001_00" / "pose").iterdir():
        pose = np.loadtxt(path)
        if np.isfinite(pose).all():
            np.savetxt(path, pose @ np.diag([1.0, -1, -1, 1]))
    with pytest.raises(SystemExit) as ended:
        run(f"check={copy}", f"output={tmp_path / 'page.html'}", "scenes=[scene0001_00]")
    assert ended.value.code == 1
    assert "OpenGL" in (tmp_path / "page.html").read_text()
    assert "OpenGL" in capsys.readouterr().out


@pytest.fixture
def asked(monkeypatch):
    """What each examination was asked, instead of examining."""
    calls = []

    def note(source, **arguments):
        calls.append(arguments)
        return Examination(source.scene_id, source.path, ())

    monkeypatch.setattr("raytran.run.prepare.check.examine", note)
    return calls


def test_annotation_and_models_are_found_above_a_single_scan(rooms, asked):
    assert check_folder(rooms / "scannet" / "scans" / "scene0001_00")[1] == 1
    assert asked[0]["annotation"].scene_id == "scene0001_00"
    assert asked[0]["shapenet_root"] == (rooms / "shapenet").resolve()


def test_annotation_and_models_may_be_elsewhere(rooms, tmp_path, asked):
    scan = shutil.copytree(rooms / "scannet" / "scans" / "scene0000_00", tmp_path / "scene0000_00")
    check_folder(scan)
    check_folder(scan, scan2cad=rooms / "scan2cad", shapenet=rooms / "shapenet")
    assert [call["annotation"] is None for call in asked] == [True, False]
    assert [call["shapenet_root"] for call in asked] == [None, rooms / "shapenet"]


def test_scans_may_be_chosen(rooms, asked):
    examinations, found = check_folder(rooms, scenes=["*02_00", "scene0000_00"])
    assert [examination.scene_id for examination in examinations] == ["scene0002_00", "scene0000_00"]
    assert found == 2
    assert [e.scene_id for e in check_folder(rooms, max_scans=2)[0]] == ["scene0000_00", "scene0002_00"]


def test_mistakes_of_the_user_are_named(rooms, tmp_path):
    with pytest.raises(DataError, match="scene0042_00 is not among the 3 scans"):
        check_folder(rooms, scenes=["scene0042_00"])
    with pytest.raises(DataError, match="no folder"):
        check_folder(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="checks=0"):
        run(f"check={rooms}", "checks=0")
