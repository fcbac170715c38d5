# SPDX-License-Identifier: Apache-2.0
"""Record3D's exports: one list of poses, images numbered in its order."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from raytran.capture.record3d import find_metadata, read_record3d
from raytran.capture.recording import open_recording
from raytran.errors import DataError

from .forms import OPENGL


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
        ({"poses": [[0, 0, 0, 1, 0, 0, 0]] * 9}, "has 9 poses and .*rgb 12 images: export both again"),
        ({"poses": [[0, 0, 0, 1]]}, "poses in .* does not hold nx7 numbers"),
        ({"K": [1, 2]}, "K in .* does not hold 3x3 numbers"),
        ({"w": None}, "w in .* is None, not a number of pixels"),
        (
            {"perFrameIntrinsicCoeffs": [[50, 51, 31, 25]] * 3},
            "perFrameIntrinsicCoeffs in .* does not hold 12x4 numbers",
        ),
        ({"poses": [[0, 0, 0, 0, 0, 0, 0]] * 12}, "none of the 12 frames .*no rigid motion"),
    ],
)
def test_mistakes_are_one_sentence(walk, folder, changes, message):
    (folder / "metadata.json").write_text(json.dumps(metadata(walk, **changes)))
    with pytest.raises(DataError, match=message):
        open_recording(read_record3d(folder))


def test_packed_or_no_recordings(folder):
    (folder / "walk.r3d").touch()
    with pytest.raises(DataError, match=r"walk\.r3d is a packed recording: unzip it and give the folder"):
        read_record3d(folder / "walk.r3d")
    shutil.rmtree(folder / "rgb")
    assert find_metadata(folder) is None
    with pytest.raises(DataError, match=r"holds no metadata\.json with rgb/ or rgbd/ beside it"):
        read_record3d(folder)
