# SPDX-License-Identifier: Apache-2.0
"""``transforms.json`` as nerfstudio, instant-ngp and synthetic data sets write it, and as nobody should."""

from __future__ import annotations

import json
import math
import struct
import zlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from raytran.capture.nerfstudio import read_nerfstudio
from raytran.capture.recording import open_recording
from raytran.errors import DataError

from .forms import OPENGL, transforms, write_transforms


def opened(walk, **changes):
    source = read_nerfstudio(write_transforms(walk, **changes))
    assert source.axes == "opengl"
    return open_recording(source)


def test_poses_intrinsics_and_images_are_those_that_were_written(walk):
    scan = opened(walk)
    assert scan.scene_id == "walk"
    assert scan.frame_id == tuple(str(n) for n in range(12))
    np.testing.assert_allclose(scan.world_from_camera.numpy() @ OPENGL, walk.poses, atol=1e-12)
    assert scan.intrinsics[0].numpy()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == list(walk.camera)
    assert scan.read_color(7)[0, 0].tolist() == [140] * 3


def test_the_applied_transform_and_scale_are_undone(walk):
    turn = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
    applied = np.c_[turn, [1.0, -2.0, 3.0]]
    moved = np.tile(np.eye(4), (12, 1, 1))
    moved[:, :3] = applied @ walk.poses
    moved[:, :3, 3] *= 0.25
    frames = transforms(walk)["frames"]
    for frame, pose in zip(frames, moved[::-1], strict=True):
        frame["transform_matrix"] = (pose @ OPENGL).tolist()
    scan = opened(walk, frames=frames, applied_transform=applied.tolist(), applied_scale=0.25)
    np.testing.assert_allclose(scan.world_from_camera.numpy() @ OPENGL, walk.poses, atol=1e-9)


def test_intrinsics_of_single_frames_come_before_the_shared_ones(walk):
    frames = transforms(walk)["frames"]
    for n, frame in enumerate(frames):
        frame["fl_x"] = 50.0 + 0.1 * n
    scan = opened(walk, frames=frames)
    # Frames are listed backwards: the first has the longest focal length. Each keeps its own.
    assert scan.intrinsics[:2, 0, 0].tolist() == pytest.approx([51.1, 51.0])
    assert (scan.intrinsics[:, 1, 1] == 51).all()
    assert scan.color_bytes(0) is not None


def test_an_angle_of_view_will_do_and_names_without_ending(walk):
    frames = transforms(walk)["frames"]
    for frame in frames:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
    angle = 2 * math.atan(64 / 2 / 50)
    (walk.folder / "transforms.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    scan = open_recording(read_nerfstudio(walk.folder))
    assert scan.intrinsics[0].numpy()[[0, 1, 0, 1], [0, 1, 2, 2]] == pytest.approx([50, 50, 32, 24])
    assert len(scan) == 12


@pytest.mark.parametrize(
    "facts",
    [
        {"k1": 0.2, "k2": -0.01, "p1": 0.003},
        {"distortion_params": [0.2, -0.01, 0.0, 0.0, 0.003, 0.0]},
        {"distortion_params": [0.2, -0.01, 0, 0, 0.003, 0], "k1": 0.9},
        {"k1": 0.2, "k2": -0.01, "p1": 0.003, "camera_model": "PINHOLE"},
        {"k1": 0.2, "k2": -0.01, "p1": 0.003, "camera_model": "SIMPLE_PINHOLE"},
    ],
)
def test_distortion_is_read_as_nerfstudio_does(walk, facts):
    """One list in the order of nerfstudio's parser, or one by one; whatever the camera model is called."""
    scan = opened(walk, **facts)
    # OpenCV's order: k1, k2, p1, p2, k3, …
    assert {lens.distortion[:5] for lens in scan.lens} == {(0.2, -0.01, 0.003, 0.0, 0.0)}
    assert scan.color_bytes(0) is None


def test_distortion_of_single_frames_as_a_list(walk):
    frames = transforms(walk)["frames"]
    frames[0]["distortion_params"] = [-0.1, 0, 0, 0, 0, 0]
    frames[1]["distortion_params"] = [-0.1]
    frames[2]["distortion_params"] = [0.1, 0, 0.02, 0]
    frames[3]["distortion_params"] = [0.1] * 12
    frames[4]["distortion_params"] = "none"
    scan = opened(walk, frames=frames)
    assert [lens.is_pinhole for lens in scan.lens] == [True] * 7 + [False] * 2
    assert scan.dropped == dict.fromkeys(("7", "8", "9"), "intrinsics that cannot be read")


def test_a_lens_that_is_none_costs_its_own_frame_alone(walk):
    frames = transforms(walk)["frames"]
    frames[0]["fl_x"] = -50
    frames[1] |= {"k1": -44.8, "k2": 1017}
    frames[2] |= {"cx": 6000}
    frames[3] |= {"w": 48, "h": 64, "cx": 25, "cy": 31}
    frames[4] |= {"w": 64, "h": 64}
    frames[5]["fl_x"] = "wide"
    frames[6]["camera_model"] = "EQUIRECTANGULAR"
    scan = opened(walk, frames=frames)
    assert scan.frame_id == ("0", "1", "2", "3", "4")
    assert scan.dropped == {
        "11": "focal lengths and centre not positive and finite",
        "10": "distortion that moves the corners out of the image",
        "9": "principal point far outside of the image",
        "8": "image turned by 90° against its intrinsics",
        "7": "image of another shape than its intrinsics are for",
        "6": "intrinsics that cannot be read",
        "5": "intrinsics that cannot be read",
    }


def test_a_principal_point_that_wanders_is_followed(walk):
    frames = transforms(walk)["frames"]
    for n, frame in enumerate(frames):
        frame |= {"cx": 31 + 4 * n, "cy": 25 - 3 * n}
    scan = opened(walk, frames=frames)
    assert scan.dropped == {}
    assert sorted(scan.intrinsics[:, 0, 2].tolist()) == [31 + 4 * n for n in range(12)]


def test_intrinsics_of_another_size_are_refused_and_those_of_crops_are_not(walk):
    with pytest.raises(DataError, match=r"principal point at \(16.0, 12.0\), the middle of 32x24 and far"):
        opened(walk, cx=16, cy=12)
    with pytest.raises(DataError, match="the middle of 48x64, turned by 90° and far from that of 64x48"):
        opened(walk, cx=24, cy=32)
    assert opened(walk, cx=0, cy=25).dropped == {}
    # Of a few frames it is taken for what the camera measured.
    frames = transforms(walk)["frames"]
    frames[3] |= {"cx": 16, "cy": 12}
    assert opened(walk, frames=frames).dropped == {}


@pytest.mark.parametrize("changes", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_a_fisheye_is_resampled(walk, changes):
    scan = opened(walk, k1=0.1, k2=0.01, **changes)
    assert (scan.lens[0].model, scan.lens[0].distortion) == ("OPENCV_FISHEYE", (0.1, 0.01, 0.0, 0.0))
    assert scan.color_bytes(0) is None
    assert scan.read_color(7)[24, 32].tolist() == [140] * 3


def test_images_without_poses_and_poses_without_images_are_counted(walk):
    frames = transforms(walk)["frames"][1:]
    (walk.folder / "images" / "4.png").unlink()
    assert opened(walk, frames=frames).dropped == {"4": "no image", "11": "no pose"}


def test_a_pose_that_is_none_is_dropped(walk):
    frames = transforms(walk)["frames"]
    frames[0]["transform_matrix"][0][0] = float("nan")
    frames[1]["transform_matrix"] = (2 * np.eye(4)).tolist()
    scan = opened(walk, frames=frames)
    assert set(scan.dropped) == {"10", "11"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": []}, "lists no frames"),
        ({"frames": [3]}, "lists no frames"),
        ({"frames": [{"transform_matrix": np.eye(4).tolist()}]}, "frame 0 of .* has no file_path"),
        ({"frames": [{"file_path": "images/0.png"}]}, "frame 0 of .* has no transform_matrix"),
        ({"fl_x": "wide"}, "has fl_x = 'wide' where a number is needed"),
        ({"fl_x": float("inf")}, "where a number is needed"),
        ({"camera_model": "OPENCV_FISHEYE", "k1": -3}, "the distortion of frame 11 .* folds the image"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR, which is not read: undistort"),
        ({"w": 100_000, "h": 100_000}, "100000x100000"),
        ({"w": 48, "h": 64, "cx": 25, "cy": 31}, "is 64x48 and its intrinsics .* for 48x64, turned by 90°:"),
        ({"w": 64, "h": 64}, "is 64x48 and its intrinsics .* for 64x64: give the images"),
        ({"w": 0, "h": 64}, "has a size of 0x64: export it again"),
        ({"k1": -44.8, "k2": 1017}, "the distortion of frame 11 .* moves the corners out of the image"),
        ({"applied_transform": [[0, 0, 0, 0]] * 3}, "applied_transform .* cannot be undone"),
        ({"applied_transform": "yes"}, "no applied_transform of"),
    ],
)
def test_mistakes_are_one_sentence(walk, changes, message):
    with pytest.raises(DataError, match=message):
        opened(walk, **changes)


@pytest.mark.parametrize("name", ["../secret.png", "/etc/passwd", "images/../../x.png", "images/\0.png", "."])
def test_paths_that_leave_the_folder_are_refused(walk, name):
    frames = transforms(walk)["frames"]
    frames[3]["file_path"] = name
    with pytest.raises(
        DataError, match=r"which is outside .*: move the images there and write relative paths"
    ):
        opened(walk, frames=frames)


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "[]", "\x00"])
def test_what_is_no_json(walk, text):
    (walk.folder / "transforms.json").write_text(text)
    with pytest.raises(DataError, match=r"transforms\.json .*: export it again"):
        read_nerfstudio(walk.folder)


def test_an_image_that_claims_to_be_huge_is_left_out(walk):
    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    (walk.folder / "images" / "5.png").write_bytes(png)
    assert opened(walk).dropped == {"5": "image cannot be read"}
    for name in walk.names:
        (walk.folder / "images" / name).write_bytes(png)
    with pytest.raises(DataError, match=r"none of the 12 frames .*\(12 image cannot be read\)"):
        opened(walk)


def test_a_list_that_is_too_long_to_be_one_is_refused_unread(walk):
    path = write_transforms(walk)
    with path.open("ab") as file:
        file.truncate(65 * 2**20)
    with pytest.raises(DataError, match="is larger than 64 MB, as no list of frames is: check the path"):
        read_nerfstudio(path)
