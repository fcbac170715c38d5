# SPDX-License-Identifier: Apache-2.0
"""Scans: order of frames, dropped frames, intrinsics, and the two real cases."""

from __future__ import annotations

import logging
import zlib

import numpy as np
import pytest
import torch
from PIL import Image

from raytran.data.scan import LOST
from raytran.data.scannet.scan import load_views, open_scan, read_scan, read_sens
from raytran.errors import DataError

from ...scan_forms import encode_sens


def test_frames_are_in_the_order_of_their_numbers(write_scan) -> None:
    scan = read_scan(write_scan(frames=(100, 9, 20, 0)))
    assert scan.scene_id == "scene0000_00"
    assert scan.frame_id == ("0", "9", "20", "100")
    assert [path.name for path in scan.image_path] == ["0.jpg", "9.jpg", "20.jpg", "100.jpg"]
    torch.testing.assert_close(
        scan.world_from_camera[:, 0, 3], torch.tensor([0, 0.09, 0.2, 1.0], dtype=torch.float64)
    )
    assert scan.image_size == (32, 48)
    assert len(scan) == 4
    assert torch.equal(scan.axis_alignment, torch.eye(4, dtype=torch.float64))


def test_frames_without_image_or_valid_pose_are_dropped_with_the_reason(write_scan) -> None:
    folder = write_scan(frames=(0, 1, 2, 3, 4, 5, 6))
    np.savetxt(folder / "pose" / "1.txt", np.full((4, 4), -np.inf))
    (folder / "pose" / "2.txt").write_text("nan " * 16)
    (folder / "pose" / "3.txt").write_text("1 0 0")
    np.savetxt(folder / "pose" / "4.txt", np.zeros((4, 4)))
    (folder / "color" / "5.jpg").unlink()
    (folder / "pose" / "6.txt").unlink()
    scan = read_scan(folder)
    assert scan.frame_id == ("0",)
    assert scan.dropped == {
        "1": LOST,
        "2": LOST,
        "3": "no camera-to-world matrix of numbers",
        "4": "pose is all zeros",
        "5": "no image",
        "6": "no pose",
    }


def test_header_gives_the_axis_alignment(write_scan) -> None:
    folder = write_scan()
    matrix = np.eye(4)
    matrix[0, 3] = -1.5
    text = " ".join(f"{value:f}" for value in matrix.ravel())
    (folder / "scene0000_00.txt").write_text(f"axisAlignment = {text} \ncolorWidth = 48\ncolorHeight = 32\n")
    assert read_scan(folder).axis_alignment[0, 3] == -1.5


def test_views_are_resized_with_their_intrinsics(write_scan) -> None:
    views, frame_id = load_views(write_scan(), image_size=(16, 96), num_views=2)
    assert frame_id == ("10", "100")
    assert views.images.shape == (1, 2, 3, 16, 96)
    assert views.images.dtype == torch.uint8
    assert views.images[0, :, 0, 8, 48].tolist() == [10, 100]
    # 48×32 → 96×16: u doubles, v halves.
    torch.testing.assert_close(
        views.intrinsics[0, 0], torch.tensor([[80.0, 0, 48], [0, 20, 8], [0, 0, 1]]), rtol=0, atol=0
    )
    torch.testing.assert_close(views.world_from_camera[0, :, :3, 3], torch.tensor([[0.1, 0, 1], [1, 0, 1]]))
    assert views.world_from_camera.dtype == torch.float32


def test_missing_parts_are_named(write_scan, tmp_path) -> None:
    with pytest.raises(DataError, match=r"there is no scan folder .*nowhere"):
        read_scan(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        DataError, match=r"empty holds nothing, so no frames of a scan: wanted are color/<n>\.jpg"
    ):
        read_scan(tmp_path / "empty")
    folder = write_scan()
    (folder / "intrinsic" / "intrinsic_color.txt").unlink()
    with pytest.raises(DataError, match=r"intrinsic_color\.txt is missing"):
        read_scan(folder)


def test_all_poses_invalid(write_scan) -> None:
    folder = write_scan()
    for path in (folder / "pose").iterdir():
        np.savetxt(path, np.full((4, 4), -np.inf))
    with pytest.raises(
        DataError, match=r"none of the 4 frames of .*scene0000_00 has an image and a valid pose"
    ):
        read_scan(folder)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_intrinsics_for_another_image_size(write_scan, factor) -> None:
    folder = write_scan()
    intrinsics = np.diag([40.0 * factor, 40 * factor, 1, 1])
    intrinsics[:2, 2] = (24 * factor, 16 * factor)
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", intrinsics)
    with pytest.raises(DataError, match="another image size than the stored 48x32"):
        read_scan(folder)


def test_intrinsics_for_a_slightly_other_size_that_the_header_states(write_scan) -> None:
    """54×36 against 48×32 differs too little to see by the principal point alone."""
    folder = write_scan()
    intrinsics = np.array([[45.0, 0, 26.8, 0], [0, 45, 18.1, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", intrinsics)
    read_scan(folder)
    (folder / "scene0000_00.txt").write_text("colorWidth = 54\ncolorHeight = 36\n")
    with pytest.raises(DataError, match="another image size"):
        read_scan(folder)


def test_intrinsics_that_are_no_matrix(write_scan) -> None:
    folder = write_scan()
    (folder / "intrinsic" / "intrinsic_color.txt").write_text("577 577 320")
    with pytest.raises(DataError, match="does not hold a 4x4 or 3x3 camera matrix"):
        read_scan(folder)


def test_damaged_header_is_named(write_scan) -> None:
    folder = write_scan()
    (folder / "scene0000_00.txt").write_text("axisAlignment = 1 0 0\n")
    with pytest.raises(DataError, match=r"axisAlignment in .*scene0000_00\.txt"):
        read_scan(folder)


def test_truncated_images_are_skipped_until_too_few_remain(write_scan) -> None:
    folder = write_scan(frames=(0, 10, 20))
    path = folder / "color" / "10.jpg"
    path.write_bytes(path.read_bytes()[:-50])
    _, frame_id = load_views(folder, image_size=(32, 48), num_views=3)
    assert frame_id == ("0", "0", "20")
    path = folder / "color" / "20.jpg"
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(DataError, match="only 1 of 3"):
        load_views(folder, image_size=(32, 48), num_views=3)


def test_a_recording_gives_the_views_of_its_export(write_sens, write_scan) -> None:
    path = write_sens(frames=4, lost=[1])
    export = write_scan("scene0009_00", frames=(0, 2, 3))
    expected, _ = load_views(export, image_size=(16, 24), num_views=3)
    for place in (path, path.parent, str(path)):
        views, frame_id = load_views(place, image_size=(16, 24), num_views=3)
        assert frame_id == ("0", "2", "3")
        torch.testing.assert_close(views.world_from_camera, expected.world_from_camera, rtol=0, atol=1e-7)
        assert torch.equal(views.intrinsics, expected.intrinsics)
        # The recording's images are of another JPEG quality.
        assert (views.images.int() - expected.images.int()).abs().max() <= 1


def test_a_recording_drops_what_an_export_drops(write_sens) -> None:
    path = write_sens(frames=5, lost=[0, 3])
    (path.parent / "scene0000_00.txt").write_text("axisAlignment = 1 0 0 5 0 1 0 0 0 0 1 0 0 0 0 1\n")
    with read_sens(path) as scan:
        assert (scan.scene_id, scan.frame_id) == ("scene0000_00", ("1", "2", "4"))
        assert scan.dropped == {"0": LOST, "3": LOST}
        assert scan.world_from_camera[:, 0, 3].tolist() == pytest.approx([0.01, 0.02, 0.04])
        assert scan.image_size == (32, 48)
        assert scan.axis_alignment[0, 3] == 5
        assert scan.damage is None
        assert scan.read_color(2)[0, 0].tolist() == [4, 4, 4]
    with pytest.raises(ValueError, match="closed file"):
        scan.read_color(0)


def test_a_cut_recording_gives_the_frames_before_and_says_so(write_sens, caplog) -> None:
    path = write_sens(frames=5, lost=[1])
    path.write_bytes(path.read_bytes()[: -2 * 128 - 8 - 10])
    with caplog.at_level(logging.WARNING), read_sens(path) as scan:
        assert scan.frame_id == ("0", "2", "3")
        assert scan.dropped["4"] == "the file ends here"
        assert scan.damage == caplog.messages[0]
        assert "ends after 4 of the 5 frames that its header promises" in scan.damage


def test_recordings_without_a_usable_frame(write_sens) -> None:
    path = write_sens(frames=3, lost=[0, 1, 2])
    with pytest.raises(
        DataError, match=r"none of the 3 frames of .*scene0000_00\.sens has an image and a valid"
    ):
        read_sens(path)
    path = write_sens("scene0001_00", frames=0)
    with pytest.raises(DataError, match="none of the 0 frames"):
        read_sens(path)


def test_exported_frames_go_before_a_recording_of_the_same_folder(write_sens, write_scan) -> None:
    write_scan()
    path = write_sens(frames=6)
    with open_scan(path.parent) as scan:
        assert scan.frame_id == ("0", "10", "20", "100")
        assert scan.path == path.parent
    with pytest.raises(DataError, match=r"there is no scan folder .*nowhere"):
        open_scan(path.parent / "nowhere")


def test_a_folder_of_recordings_is_no_scan(write_sens) -> None:
    path = write_sens()
    path.with_name("scene0001_00.sens").write_bytes(path.read_bytes())
    with pytest.raises(DataError, match=r"scene0000_00 holds 2 recordings: give the path of one of them"):
        open_scan(path.parent)


def test_a_header_may_lie_elsewhere_and_state_no_size(write_scan, tmp_path) -> None:
    header = tmp_path / "elsewhere.txt"
    header.write_text("colorWidth = 0\ncolorHeight = 0\naxisAlignment = 1 0 0 2 0 1 0 0 0 0 1 0 0 0 0 1\n")
    assert read_scan(write_scan(), header=header).axis_alignment[0, 3] == 2
    header.write_text("axisAlignment = one\n")
    with pytest.raises(DataError, match=r"axisAlignment in .*elsewhere\.txt"):
        read_scan(write_scan("scene0001_00"), header=header)


def test_real_scan_with_lost_frames(shared_dir) -> None:
    folder = shared_dir / "realdata" / "scene0470_00" / "scannet" / "scans" / "scene0470_00"
    scan = read_scan(folder)
    assert sorted(scan.dropped) == ["255", "605"]
    assert scan.frame_id == tuple(str(n) for n in range(0, 600, 10))
    assert scan.image_size == (480, 640)
    assert scan.intrinsics[0, 0].tolist() == [577.870605, 0.0, 319.5]
    # The scan is turned by 4.3° against its walls; poses stay as they are.
    angle = torch.atan2(scan.axis_alignment[1, 0], scan.axis_alignment[0, 0]).rad2deg()
    assert angle.item() == pytest.approx(-4.3, abs=0.05)
    expected = np.loadtxt(folder / "pose" / "10.txt")
    np.testing.assert_array_equal(scan.world_from_camera[1].numpy(), expected)


def test_real_scan_packed_as_a_recording(shared_dir, tmp_path) -> None:
    """Images, depth maps and lost poses of a real scan, as its recording would hold them."""
    folder = shared_dir / "realdata" / "scene0470_00" / "scannet" / "scans" / "scene0470_00"
    scan = read_scan(folder)
    names = sorted((path.stem for path in (folder / "pose").iterdir()), key=int)
    color = [(folder / "color" / f"{name}.jpg").read_bytes() for name in names]
    maps = [np.array(Image.open(folder / "depth" / f"{name}.png"), np.uint16) for name in names[:3]]
    depth = [zlib.compress(values.tobytes()) for values in maps] + [b""] * (len(names) - 3)
    poses = np.stack([np.loadtxt(folder / "pose" / f"{name}.txt") for name in names])
    path = tmp_path / "scene0470_00.sens"
    sizes = {"color_size": (480, 640), "depth_size": maps[0].shape}
    matrix = np.loadtxt(folder / "intrinsic" / "intrinsic_color.txt")
    path.write_bytes(encode_sens(color, depth, poses, intrinsics=matrix, **sizes))
    with read_sens(path, header=folder / "scene0470_00.txt") as recording:
        assert [names[int(name)] for name in recording.frame_id] == list(scan.frame_id)
        assert {names[int(name)]: reason for name, reason in recording.dropped.items()} == scan.dropped
        torch.testing.assert_close(recording.world_from_camera, scan.world_from_camera, rtol=0, atol=4e-7)
        assert torch.equal(recording.axis_alignment, scan.axis_alignment)
        torch.testing.assert_close(recording.intrinsics, scan.intrinsics, rtol=1e-7, atol=0)
        for index in (0, 7, 59):
            assert recording.color_bytes(index) == scan.color_bytes(index)
            np.testing.assert_array_equal(recording.read_color(index), scan.read_color(index))
        for index, values in enumerate(maps):
            np.testing.assert_array_equal(recording.file.read_depth(index), values)


def test_real_walk_is_resized_to_another_aspect(shared_dir) -> None:
    folder = shared_dir / "realdata" / "hololens_lounge" / "scans" / "hololens_000"
    scan = read_scan(folder)
    assert scan.image_size == (360, 540)
    assert len(scan) == 96
    assert scan.dropped == {}
    views, frame_id = load_views(folder, image_size=(480, 640), num_views=4)
    assert views.images.shape == (1, 4, 3, 480, 640)
    assert [int(n) for n in frame_id] == sorted(int(n) for n in frame_id)
    matrix = views.intrinsics[0, 0]
    torch.testing.assert_close(matrix[0], torch.tensor([495.567757, 0, 269.502897]) * 640 / 540)
    torch.testing.assert_close(matrix[1], torch.tensor([0, 495.481963, 169.194112]) * 480 / 360)
    with Image.open(folder / "color" / f"{frame_id[0]}.jpg") as image:
        mean = np.asarray(image, dtype=float).mean(axis=(0, 1))
    np.testing.assert_allclose(views.images[0, 0].float().mean(dim=(1, 2)), mean, atol=1.0)


def test_images_of_another_shape_are_dropped_and_those_of_another_size_used(write_scan) -> None:
    folder = write_scan(frames=range(9))
    for n, size in ((0, (30, 30)), (2, (32, 48)), (4, (24, 16)), (5, (96, 64)), (7, (32, 48))):
        Image.new("RGB", size, (n, n, n)).save(folder / "color" / f"{n}.jpg", quality=95)
    scan = read_scan(folder)
    assert (scan.image_size, scan.frame_id) == ((32, 48), ("1", "3", "4", "5", "6", "8"))
    turned = "image turned by 90° against its intrinsics"
    shape = "image of another shape than its intrinsics are for"
    assert scan.dropped == {"0": shape, "2": turned, "7": turned}
    assert scan.intrinsics.shape == (6, 3, 3)
    assert scan.world_from_camera[:, 0, 3].tolist() == pytest.approx([0.01, 0.03, 0.04, 0.05, 0.06, 0.08])
    for index, number in ((2, 4), (3, 5)):
        assert (scan.read_color(index) == number).all()
        assert scan.read_color(index).shape == (32, 48, 3)
        assert scan.read_color(index, (8, 16)).shape == (8, 16, 3)
        assert scan.color_bytes(index) is None
    assert scan.color_bytes(0) is not None
    views, used = load_views(folder, image_size=(16, 24), num_views=6)
    assert used == scan.frame_id
    assert (views.intrinsics == views.intrinsics[:, :1]).all()
    assert views.picture is None


def test_the_images_that_the_intrinsics_fit_are_used_though_most_are_turned(write_scan) -> None:
    folder = write_scan(frames=range(5))
    for n in (0, 2, 4):
        Image.new("RGB", (32, 48)).save(folder / "color" / f"{n}.jpg")
    scan = read_scan(folder)
    assert (scan.image_size, scan.frame_id) == ((32, 48), ("1", "3"))
    for n in (1, 3):
        Image.new("RGB", (32, 48)).save(folder / "color" / f"{n}.jpg")
    with pytest.raises(DataError, match="images turned by 90° against the stored 32x48: give the intrinsics"):
        read_scan(folder)


def test_an_image_whose_header_is_damaged_is_named_when_it_is_read(write_scan) -> None:
    folder = write_scan(frames=range(4))
    (folder / "color" / "0.jpg").write_bytes(b"no image")
    scan = read_scan(folder)
    assert scan.image_size == (32, 48)
    assert load_views(folder, image_size=(32, 48), num_views=4)[1] == ("1", "1", "2", "3")


def test_intrinsics_of_a_crop(write_scan) -> None:
    folder = write_scan()
    matrix = np.diag([40.0, 40, 1, 1])
    matrix[:2, 2] = (4, 30)
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", matrix)
    assert read_scan(folder).intrinsics[0, 0, 2] == 4


@pytest.mark.parametrize(
    "write",
    [
        lambda pose: "\ufeff" + "\n".join(" ".join(map(str, row)) for row in pose),
        lambda pose: "\n".join(",".join(map(str, row)) for row in pose),
        lambda pose: "\r\n".join("; ".join(map(str, row)) for row in pose),
        lambda pose: "\n".join(" ".join(map(str, row)) for row in pose[:3]),
        lambda pose: " ".join(map(str, pose.ravel())),
        lambda pose: ", ".join(map(str, pose[:3].ravel())),
        lambda pose: "# camera to world\n" + "\n".join("\t".join(map(str, row)) for row in pose),
    ],
    ids=["mark", "commas", "semicolons", "3x4", "one line", "12 in one line", "comment"],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_poses_as_other_programs_write_them(write_scan, write, encoding) -> None:
    folder = write_scan()
    expected = read_scan(folder).world_from_camera
    for path in (folder / "pose").iterdir():
        text = write(np.loadtxt(path))
        path.write_text(text.lstrip("\ufeff") if encoding == "utf-16" else text, encoding=encoding)
    assert torch.equal(read_scan(folder).world_from_camera, expected)


def test_a_rotation_alone_is_no_pose(write_scan) -> None:
    folder = write_scan(frames=(0, 1, 2))
    np.savetxt(folder / "pose" / "1.txt", np.eye(3))
    np.savetxt(folder / "pose" / "2.txt", np.eye(4) * [1, 1, -1, 1])
    assert read_scan(folder).dropped == {
        "1": "no camera-to-world matrix of numbers",
        "2": "left-handed pose (determinant −1)",
    }


def test_all_poses_left_handed_or_scaled(write_scan) -> None:
    folder = write_scan()
    poses = {path: np.loadtxt(path) for path in (folder / "pose").iterdir()}
    for spoil, said in (
        (np.diag([1.0, 1, -1, 1]), r"4 left-handed pose \(determinant −1\).*: one axis is mirrored"),
        (np.diag([0.5, 0.5, 0.5, 1]), "4 rotation scaled by 0.5.*: divide the upper left 3x3"),
    ):
        for path, pose in poses.items():
            np.savetxt(path, spoil @ pose)
        with pytest.raises(DataError, match=said):
            read_scan(folder)


def test_the_depth_cameras_intrinsics_are_not_taken(write_scan) -> None:
    folder = write_scan()
    (folder / "intrinsic" / "intrinsic_color.txt").rename(folder / "intrinsic" / "intrinsic_depth.txt")
    with pytest.raises(
        DataError, match=r"intrinsic_depth\.txt is of the depth camera, and intrinsic_color\.txt"
    ):
        read_scan(folder)
    assert read_scan(folder, intrinsics=(40, 41, 24, 16)).intrinsics.reshape(-1, 3, 3)[0, 1, 1] == 41


def test_the_header_is_held_against_the_intrinsics_and_does_not_replace_them(write_scan, caplog) -> None:
    folder = write_scan()
    path = folder / "intrinsic" / "intrinsic_color.txt"
    header = "colorWidth = 48\ncolorHeight = 32\nfx_color = {}\nfy_color = 40\nmx_color = 24\nmy_color = 16\n"
    (folder / "scene0000_00.txt").write_text(header.format(40.7))
    assert read_scan(folder).intrinsics.reshape(-1, 3, 3)[0, 0, 0] == 40
    assert "differ by 1.7 % in the intrinsics of the colour camera: the former are taken" in caplog.text
    path.unlink()
    with pytest.raises(DataError, match=r"intrinsic_color\.txt is missing: .*or give intrinsics=fx,fy,cx,cy"):
        read_scan(folder)


def test_intrinsics_as_four_numbers(write_scan) -> None:
    folder = write_scan()
    (folder / "intrinsic" / "intrinsic_color.txt").write_text("40, 41, 24, 16\n", encoding="utf-8-sig")
    assert read_scan(folder).intrinsics.reshape(-1, 3, 3)[0].tolist() == [[40, 0, 24], [0, 41, 16], [0, 0, 1]]
