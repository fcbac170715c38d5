# SPDX-License-Identifier: Apache-2.0
"""``transforms.json`` as nerfstudio, instant-ngp and synthetic data sets write it, and as nobody should."""

from __future__ import annotations

import json
import math
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from raytran.capture.nerfstudio import find_transforms, read_nerfstudio
from raytran.capture.recording import open_recording
from raytran.errors import DataError

from .forms import OPENGL, check_frames, transforms, write_transforms


def opened(walk, **changes):
    source = read_nerfstudio(write_transforms(walk, **changes))
    assert source.axes == "opengl"
    return open_recording(source)


def test_poses_intrinsics_and_images_are_those_that_were_written(walk):
    scan = opened(walk)
    assert scan.scene_id == "walk"
    assert scan.frame_id == tuple(str(n) for n in range(12))
    np.testing.assert_allclose(scan.world_from_camera.numpy() @ OPENGL, walk.poses, atol=1e-12)
    assert scan.intrinsics.numpy()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == list(walk.camera)
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
    # Frames are listed backwards: the first has the longest focal length.
    assert [round(lens.focal[0], 3) for lens in scan.lens[:2]] == [51.1, 51.0]
    assert scan.pinhole.focal[1] / 51.0 == pytest.approx(scan.pinhole.focal[0] / 50.55)


def test_an_angle_of_view_will_do_and_names_without_ending(walk):
    frames = transforms(walk)["frames"]
    for frame in frames:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
    angle = 2 * math.atan(64 / 2 / 50)
    (walk.folder / "transforms.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    scan = open_recording(read_nerfstudio(walk.folder))
    assert scan.intrinsics.numpy()[[0, 1, 0, 1], [0, 1, 2, 2]] == pytest.approx([50, 50, 32, 24])
    assert len(scan) == 12


def test_distortion_is_read_unless_the_model_has_none(walk):
    assert opened(walk, k1=0.2).color_bytes(0) is None
    assert opened(walk, k1=0.2, camera_model="PINHOLE").color_bytes(0) is not None


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
        ({"fl_x": "wide"}, "fl_x in frame 0 of .* is 'wide', not a focal length"),
        ({"fl_x": float("inf")}, "is inf, not a focal length"),
        ({"camera_model": "OPENCV_FISHEYE", "k1": -3}, "the distortion of frame 0 .* folds the image"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR, which is not read: undistort"),
        ({"w": 100_000, "h": 100_000}, "is 100000, not a number of pixels of 1 to 8192"),
        ({"w": 48, "h": 64, "cx": 25, "cy": 31}, "is 64x48 and its intrinsics .* for 48x64, turned by 90°"),
        ({"applied_transform": [[0, 0, 0, 0]] * 3}, "applied_transform .* cannot be undone"),
        ({"applied_transform": "yes"}, "applied_transform in .* does not hold nx4 numbers"),
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
    with pytest.raises(DataError, match="is larger than 64 MB, as no such file is: check the path"):
        read_nerfstudio(path)


def test_entries_that_are_damaged_are_left_out(walk):
    frames = transforms(walk)["frames"][::-1]
    del frames[1]["transform_matrix"]
    frames[2]["transform_matrix"][0][1] = "north"
    frames[3]["fl_x"] = -1
    frames[4]["transform_matrix"][0][3] = 1e300
    frames[5] = "images/5.png"
    frames[6]["file_path"] = 6
    frames[7]["transform_matrix"] = [[1, 0], [0, 1]]
    frames[8]["k1"] = "none"
    scan = opened(walk, frames=frames)
    matrix, lens = "no camera-to-world matrix of numbers", "impossible intrinsics"
    assert scan.dropped == {
        **dict.fromkeys(("1", "2", "7"), matrix),
        **dict.fromkeys(("3", "8"), lens),
        "4": "pose is not finite or out of bounds",
        **dict.fromkeys(("frame 5", "frame 6"), "no image is named"),
        **dict.fromkeys(("5", "6"), "no pose"),
    }
    scan = replace(scan, world_from_camera=scan.world_from_camera @ torch.from_numpy(OPENGL))
    check_frames(scan, walk, [0, 9, 10, 11])


@pytest.mark.parametrize("name", ["transforms_undistorted.json", "transforms.json"])
def test_scannetpp(walk, name):
    dslr = walk.folder / "scene" / "dslr"
    folder = "resized_undistorted_images" if "undistorted" in name else "resized_images"
    (dslr / "nerfstudio").mkdir(parents=True)
    (walk.folder / "images").rename(dslr / folder)
    frames = [
        frame | {"file_path": frame["file_path"].removeprefix("images/"), "is_bad": n in (3, 11)}
        for n, frame in enumerate(transforms(walk)["frames"][::-1])
    ]
    content = transforms(walk, frames=frames[:8], test_frames=frames[8:])
    (dslr / "nerfstudio" / name).write_text(json.dumps(content))
    for path in (walk.folder / "scene", dslr, dslr / "nerfstudio", dslr / "nerfstudio" / name):
        scan = open_recording(read_nerfstudio(path))
        assert scan.scene_id == "scene"
        assert scan.dropped == {"3": "marked as bad", "11": "marked as bad"}
        scan = replace(scan, world_from_camera=scan.world_from_camera @ torch.from_numpy(OPENGL))
        check_frames(scan, walk, [n for n in range(12) if n not in (3, 11)])


def test_undistorted_images_of_scannetpp_come_first_if_they_are_there(walk):
    folder = walk.folder / "dslr" / "nerfstudio"
    folder.mkdir(parents=True)
    (walk.folder / "images").rename(walk.folder / "dslr" / "resized_images")
    for name in ("transforms.json", "transforms_undistorted.json"):
        (folder / name).write_text("{}")
    assert find_transforms(walk.folder) == folder / "transforms.json"
    (walk.folder / "dslr" / "resized_undistorted_images").mkdir()
    assert find_transforms(walk.folder) == folder / "transforms_undistorted.json"


def test_lists_for_training_validation_and_test_are_one_walk(walk):
    frames = transforms(walk)["frames"]
    for name, part in (("train", frames[:6]), ("val", frames[5:8]), ("test", frames[8:])):
        content = transforms(walk, frames=part)
        (walk.folder / f"transforms_{name}.json").write_text(json.dumps(content))
    scan = open_recording(read_nerfstudio(walk.folder))
    scan = replace(scan, world_from_camera=scan.world_from_camera @ torch.from_numpy(OPENGL))
    check_frames(scan, walk)
    # A list that is named is read alone.
    assert len(read_nerfstudio(walk.folder / "transforms_train.json").frames) == 6


def test_a_list_of_a_windows_machine(walk):
    frames = transforms(walk)["frames"]
    for frame in frames:
        frame["file_path"] = "C:\\walk\\" + frame["file_path"].replace("/", "\\").replace(".png", ".PNG")
    scan = opened(walk, frames=frames)
    assert scan.frame_id[11] == "11"
    scan = replace(scan, world_from_camera=scan.world_from_camera @ torch.from_numpy(OPENGL))
    check_frames(scan, walk)


def test_typed_intrinsics_fill_in_what_is_missing(walk):
    path = write_transforms(walk)
    content = {"frames": json.loads(path.read_text())["frames"]}
    path.write_text(json.dumps(content))
    scan = open_recording(read_nerfstudio(path, walk.camera))
    assert scan.intrinsics.numpy()[..., [0, 1, 0, 1], [0, 1, 2, 2]].reshape(-1)[:4].tolist() == [*walk.camera]
    with pytest.raises(DataError, match=r"frame 0 of .* has no fl_x"):
        read_nerfstudio(path)
