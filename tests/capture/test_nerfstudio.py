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
from PIL import Image
from scipy.spatial.transform import Rotation

from raytran.capture.nerfstudio import find_transforms, read_nerfstudio
from raytran.capture.recording import open_recording
from raytran.data.images import FILL
from raytran.data.scan import scan_views
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
    scan = opened(walk, frames=frames)
    assert [lens.is_pinhole for lens in scan.lens] == [True] * 10 + [False] * 2


@pytest.mark.parametrize("params", [[0.1, 0, 0.02, 0], [0.1, 0, 0.02, 0, 0], [0.1] * 12])
def test_a_list_of_which_nobody_knows_the_order(walk, params):
    with pytest.raises(DataError, match=rf"has {len(params)} distortion_params, not k1, k2, k3, k4, p1, p2"):
        opened(walk, distortion_params=params)


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
        ({"fl_x": "wide"}, "fl_x in frame 0 of .* is 'wide', not a focal length"),
        ({"fl_x": float("inf")}, "is inf, not a focal length"),
        ({"camera_model": "OPENCV_FISHEYE", "k1": -3}, "the distortion of frame 0 .* folds the image"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR, which is not read: undistort"),
        ({"w": 100_000, "h": 100_000}, "is 100000, not a number of pixels of 1 to 8192"),
        ({"w": 48, "h": 64, "cx": 25, "cy": 31}, "is 64x48 and its intrinsics .* for 48x64, turned by 90°:"),
        ({"w": 64, "h": 64}, "is 64x48 and its intrinsics .* for 64x64: give the images"),
        ({"w": 0, "h": 64}, "w in frame 0 of .* is 0, not a number of pixels"),
        ({"k1": -44.8, "k2": 1017}, "the distortion of frame 0 .* moves the corners out of the image"),
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


def rotated(walk, numbers, quarters=1):
    """Make some images upright ones; return the entries of all frames, with the lenses of these."""
    frames = transforms(walk)["frames"]
    for n in numbers:
        path = walk.folder / "images" / f"{n}.png"
        with Image.open(path) as image:
            turned = Image.new("RGB", image.size[::-1], image.getpixel((0, 0)))
        turned.save(path)
        frames[11 - n] |= {"w": 48, "h": 64, "fl_x": 51.0, "fl_y": 50.0, "cx": 25.0, "cy": 31.0}
    return frames


def test_portrait_frames_among_landscape_ones_keep_their_lens(walk):
    scan = opened(walk, frames=rotated(walk, [3, 7]))
    assert (len(scan), scan.dropped, scan.image_size) == (12, {}, (48, 64))
    # 48x64 becomes 36x48, in the middle of 64x48.
    assert scan.picture.tolist() == [
        [14.0, 0, 50, 48] if n in (3, 7) else [0.0, 0, 64, 48] for n in range(12)
    ]
    expected = [[51 * 0.75, 0, 25 * 0.75 + 14], [0, 50 * 0.75, 31 * 0.75], [0, 0, 1]]
    assert scan.intrinsics[3].tolist() == expected
    assert scan.intrinsics[4].tolist() == [[50, 0, 31], [0, 51, 25], [0, 0, 1]]
    image = scan.read_color(7)
    assert (image[:, 14:50] == 140).all()
    assert (image[:, [0, 13, 50, 63]] == np.array(FILL)).all()
    assert scan.color_bytes(7) is None
    assert scan.color_bytes(4) is not None
    assert scan.read_color(7, (24, 32))[:, 7:25].ravel().tolist() == [140] * (24 * 18 * 3)


def test_the_views_know_their_pictures_if_one_is_filled_up(walk):
    scan = opened(walk, frames=rotated(walk, [3, 7]))
    views, used = scan_views(scan, [2, 3, 4], image_size=(24, 64))
    assert used == [2, 3, 4]
    assert views.picture[0].tolist() == [[0, 0, 64, 24], [14, 0, 50, 24], [0, 0, 64, 24]]
    assert views.intrinsics[0, 1, 1].tolist() == [0, 50 * 0.75 / 2, 31 * 0.75 / 2]
    assert scan_views(scan, [2, 4], image_size=(24, 64))[0].picture is None


def test_a_point_is_seen_at_the_same_place_of_a_portrait_frame(walk):
    """A bright square where a point of the world is seen: it lies there in the filled-up image, too."""
    frames = rotated(walk, [5])
    pixels = np.zeros((64, 48, 3), np.uint8)
    pixels[12:16, 32:36] = 255
    Image.fromarray(pixels).save(walk.folder / "images" / "5.png")
    scan = opened(walk, frames=frames)
    own = torch.tensor([[51.0, 0, 25], [0, 50, 31], [0, 0, 1]], dtype=torch.float64)
    camera = scan.cameras[5]
    ray = torch.linalg.inv(own) @ torch.tensor([34.0, 14.0, 1.0], dtype=torch.float64)
    point = camera.world_from_camera[:3, :3] @ (2 * ray) + camera.position
    for size in ((48, 64), (240, 320), (96, 64)):
        scaled = camera.scaled_to(size)
        place, depth = scaled.project(point[None])
        assert scaled.sees(place, depth).all()
        image = scan.read_color(5, size)[..., 0].astype(float)
        image[(scan.read_color(5, size) == np.array(FILL)).all(axis=2)] = 0
        rows, columns = np.mgrid[: size[0], : size[1]] + 0.5
        found = (image * columns).sum() / image.sum(), (image * rows).sum() / image.sum()
        assert place[0].tolist() == pytest.approx(found, abs=0.15)


def test_a_stray_picture_is_used_with_a_lens_of_its_own_and_dropped_without(walk):
    frames = transforms(walk)["frames"]
    for n in (2, 6):
        Image.new("RGB", (300, 300), (20 * n,) * 3).save(walk.folder / "images" / f"{n}.png")
    frames[11 - 6] |= {"w": 300, "h": 300, "fl_x": 250.0, "fl_y": 250.0, "cx": 150.0, "cy": 150.0}
    scan = opened(walk, frames=frames)
    assert scan.dropped == {"2": "image of another shape than its intrinsics are for"}
    frame = scan.frame_id.index("6")
    assert scan.picture[frame].tolist() == [8, 0, 56, 48]
    assert scan.intrinsics[frame].numpy() == pytest.approx(np.array([[40, 0, 32], [0, 40, 24], [0, 0, 1.0]]))


def test_the_most_frequent_size_is_that_of_the_scan(walk):
    scan = opened(walk, frames=rotated(walk, range(7)))
    assert scan.image_size == (64, 48)
    assert scan.picture[0].tolist() == [0, 0, 48, 64]
    assert scan.picture[11].tolist() == [0, 14, 48, 50]


def test_each_distorted_frame_becomes_a_pinhole_of_its_own(walk):
    frames = transforms(walk)["frames"]
    frames[0] |= {"k1": 0.3}
    frames[1] |= {"k1": -0.2}
    frames[2] |= {"fl_x": 56.0, "fl_y": 57.1}
    scan = opened(walk, frames=frames)
    assert [lens.is_pinhole for lens in scan.lens] == [True] * 10 + [False] * 2
    assert scan.intrinsics[11, 0, 0] > 50
    assert scan.intrinsics[10, 0, 0] == 50
    assert (scan.intrinsics[9, 0, 0], scan.intrinsics[0, 0, 0]) == (56, 50)
    assert [scan.color_bytes(n) is None for n in range(12)] == [False] * 10 + [True] * 2


def test_a_stray_picture_that_comes_first_does_not_say_the_size_of_all(walk):
    """Neither width nor height is written: it is that of most images, not of the first."""
    Image.new("RGB", (300, 300)).save(walk.folder / "images" / "11.png")
    angle = 2 * math.atan(64 / 2 / 50)
    content = {"camera_angle_x": angle, "frames": transforms(walk)["frames"]}
    (walk.folder / "transforms.json").write_text(json.dumps(content))
    scan = open_recording(read_nerfstudio(walk.folder))
    assert scan.dropped == {"11": "image of another shape than its intrinsics are for"}
    assert (scan.image_size, scan.intrinsics[0, 0, 0].item()) == ((48, 64), pytest.approx(50))


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
