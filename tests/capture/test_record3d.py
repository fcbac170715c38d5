# SPDX-License-Identifier: Apache-2.0
"""Record3D's exports: one list of poses, images numbered in its order."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from raytran.capture.record3d import find_metadata, read_record3d
from raytran.capture.recording import open_recording
from raytran.errors import DataError

from .forms import OPENGL, check_frames


def metadata(walk, **changes):
    opengl = walk.poses @ OPENGL
    turns = Rotation.from_matrix(opengl[:, :3, :3]).as_quat()
    fx, fy, cx, cy = walk.camera
    height, width = walk.image_size
    content = {
        "poses": np.c_[turns, opengl[:, :3, 3]].tolist(),
        "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1],  # column by column
        "w": width,
        "h": height,
        "fps": 30,
    }
    return content | changes


@pytest.fixture
def folder(walk):
    """The walk as an export: images ``rgb/0.png`` and so on."""
    (walk.folder / "images").rename(walk.folder / "rgb")
    (walk.folder / "metadata.json").write_text(json.dumps(metadata(walk)))
    return walk.folder


def test_an_export_is_read(walk, folder):
    source = read_record3d(folder)
    assert (source.axes, source.up, source.metric) == ("opengl", None, True)
    scan = open_recording(source)
    np.testing.assert_allclose(scan.world_from_camera.numpy() @ OPENGL, walk.poses, atol=1e-9)
    assert scan.intrinsics[0].numpy()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == list(walk.camera)
    # 10 comes after 9, as its pose does.
    assert scan.read_color(10)[0, 0].tolist() == [200] * 3


@pytest.mark.parametrize("images", ["rgbd", "EXR_RGBD/rgb"])
def test_an_unzipped_recording_and_its_other_form(walk, folder, images):
    (folder / images).parent.mkdir(exist_ok=True)
    (folder / "rgb").rename(folder / images)
    (folder / "metadata.json").rename(folder / "metadata")
    (folder / images / "0.depth").write_bytes(b"lzfse")
    assert find_metadata(folder) == folder / "metadata"
    assert len(open_recording(read_record3d(folder))) == 12


def test_a_focus_that_changes_is_followed(walk, folder):
    table = [[50 + 0.1 * n, 51, 31, 25] for n in range(12)]
    (folder / "metadata.json").write_text(json.dumps(metadata(walk, perFrameIntrinsicCoeffs=table)))
    scan = open_recording(read_record3d(folder))
    assert scan.intrinsics[:, 0, 0].tolist() == pytest.approx([row[0] for row in table])
    assert scan.color_bytes(11) is not None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"poses": [[0, 0, 0, 1, 0, 0, 0]] * 9},
            "metadata.json: 12 images and 9 poses without times, so what belongs together is unknown",
        ),
        ({"poses": [[0, 0, 0, 1]]}, "poses in .* does not hold nx7 numbers"),
        ({"K": [1, 2]}, "K in .* does not hold 3x3 numbers"),
        ({"w": None}, "w in .* is None, not a number of pixels"),
        (
            {"perFrameIntrinsicCoeffs": [[50, 51, 31, 25]] * 3},
            "perFrameIntrinsicCoeffs in .* does not hold 12x4 numbers",
        ),
        ({"poses": [[0, 0, 0, 0, 0, 0, 0]] * 12}, "none of the 12 frames .*12 pose is not finite"),
    ],
)
def test_mistakes_are_one_sentence(walk, folder, changes, message):
    (folder / "metadata.json").write_text(json.dumps(metadata(walk, **changes)))
    with pytest.raises(DataError, match=message):
        open_recording(read_record3d(folder))


def test_no_recording(folder):
    shutil.rmtree(folder / "rgb")
    assert find_metadata(folder) is None
    with pytest.raises(DataError, match=r"holds no metadata\.json with rgb/ or rgbd/ beside it"):
        read_record3d(folder)


def check(scan, walk, numbers=None):
    scan = replace(scan, world_from_camera=scan.world_from_camera @ torch.from_numpy(OPENGL))
    check_frames(scan, walk, numbers)


def test_one_pose_or_image_more_is_the_last(walk, folder, caplog):
    (folder / "rgb" / "11.png").unlink()
    scan = open_recording(read_record3d(folder))
    assert scan.dropped == {"pose 11": "no image"}
    check(scan, walk, range(11))
    assert "the last pose has no partner" in caplog.text
    content = metadata(walk)
    (folder / "metadata.json").write_text(json.dumps(content | {"poses": content["poses"][:10]}))
    scan = open_recording(read_record3d(folder))
    assert scan.dropped == {"10": "no pose"}
    check(scan, walk, range(10))


@pytest.mark.parametrize("missing", [(0,), (4,), (4, 7)])
def test_images_that_are_missing_are_known_by_the_numbers_of_the_others(walk, folder, missing):
    for n in missing:
        (folder / "rgb" / f"{n}.png").unlink()
    scan = open_recording(read_record3d(folder))
    assert set(scan.dropped) == {f"pose {n}" for n in missing}
    check(scan, walk, [n for n in range(12) if n not in missing])


def test_where_the_order_is_not_certain_nothing_is_matched(walk, folder):
    for n in range(11):
        (folder / "rgb" / f"{n}.png").rename(folder / "rgb" / f"IMG_{7 * n + 100}.png")
    (folder / "rgb" / "11.png").unlink()
    with pytest.raises(DataError, match="11 images and 12 poses without times"):
        read_record3d(folder)


def test_files_of_macos_are_ignored(walk, folder):
    for path in (folder / "rgb").iterdir():
        path.with_name(f"._{path.name}").write_bytes(b"Mac OS X")
    check(open_recording(read_record3d(folder)), walk)


def test_damaged_poses_are_left_out_and_typed_intrinsics_come_first(walk, folder):
    content = metadata(walk, K=None)
    content["poses"][3] = [0, 0, 0, 1]
    content["poses"][4][5] = "north"
    (folder / "metadata.json").write_text(json.dumps(content))
    scan = open_recording(read_record3d(folder, walk.camera))
    assert set(scan.dropped) == {"3", "4"}
    check(scan, walk, [0, 1, 2, *range(5, 12)])
    assert scan.lens[0].focal == (50.0, 51.0)
