# SPDX-License-Identifier: Apache-2.0
"""Recordings of Stray Scanner, with a video and with its extracted images."""

from __future__ import annotations

import importlib.util
import shutil

import pytest
from PIL import Image

from raytran.capture.recording import open_recording
from raytran.capture.stray import find_odometry, open_stray, read_stray
from raytran.errors import DataError

from .forms import Y_UP, check_frames, write_stray, write_video


@pytest.fixture
def folder(walk):
    return write_stray(walk, walk.folder.parent / "stray")


def test_extracted_images(walk, folder):
    source = read_stray(folder)
    assert (source.axes, source.up, source.metric, source.scene_id) == ("opencv", (0, 1, 0), True, "stray")
    scan = open_recording(source)
    check_frames(scan, walk, turn=Y_UP)
    assert scan.lens[0].focal == (50.0, 51.0)


@pytest.mark.skipif(importlib.util.find_spec("av") is None, reason="videos need PyAV")
def test_a_video(walk, folder):
    shutil.rmtree(folder / "rgb")
    write_video(walk, folder / "rgb.mp4")
    for path in (folder, folder / "rgb.mp4"):
        source = read_stray(path)
        assert source.scene_id == "stray"
        with open_stray(source) as scan:
            check_frames(scan, walk, turn=Y_UP)


def test_rows_belong_to_the_images_of_their_numbers(walk, folder):
    listed = folder / "odometry.csv"
    rows = listed.read_text().splitlines()
    listed.write_text("\n".join([rows[0], *rows[:4:-1], *rows[1:4]]))  # another order, without frame 3
    (folder / "rgb" / "000007.png").unlink()
    scan = open_recording(read_stray(folder))
    assert scan.dropped == {"000003": "no pose", "7": "no image"}
    check_frames(scan, walk, [n for n in range(12) if n not in (3, 7)], turn=Y_UP)


@pytest.mark.parametrize("heading", [True, False])
def test_the_apps_first_form_has_no_numbers(walk, folder, heading):
    listed = folder / "odometry.csv"
    rows = [row.split(",", 2)[2].strip() for row in listed.read_text().splitlines()]
    listed.write_text("\n".join(rows if heading else rows[1:]))
    check_frames(open_recording(read_stray(folder)), walk, turn=Y_UP)


@pytest.mark.parametrize("size", [(96, 72), (960, 720)])
def test_smaller_images_scale_the_camera_of_the_video(walk, folder, size):
    (folder / "camera_matrix.csv").write_text("1440,0,960\n0,1440,720\n0,0,1\n")
    for path in (folder / "rgb").iterdir():
        with Image.open(path) as image:
            image.load()
        image.resize(size).save(path)
    scan = open_recording(read_stray(folder))
    assert scan.lens[0].size == size[::-1]
    assert scan.lens[0].focal == pytest.approx((0.75 * size[0], size[1]))


def test_what_is_missing_is_named(walk, folder):
    (folder / "camera_matrix.csv").unlink()
    with pytest.raises(
        DataError, match=r"camera_matrix\.csv is missing: copy .*or give intrinsics=fx,fy,cx,cy"
    ):
        read_stray(folder)
    assert len(read_stray(folder, walk.camera).frames) == 12
    (folder / "odometry.csv").write_text("1,2,3\n")
    with pytest.raises(DataError, match="has 3 columns, not timestamp, frame, x, y, z"):
        read_stray(folder, walk.camera)
    shutil.rmtree(folder / "rgb")
    assert find_odometry(folder) is None
    with pytest.raises(DataError, match=r"holds no odometry\.csv beside rgb\.mp4 or rgb/"):
        read_stray(folder)
