# SPDX-License-Identifier: Apache-2.0
"""Matrices, key = value files, and intrinsics that fit their images or not."""

from __future__ import annotations

import numpy as np
import pytest

from raytran.data.scannet.text import (
    are_rigid,
    check_intrinsics,
    read_frame_cameras,
    read_header,
    read_intrinsics,
    read_matrix,
)
from raytran.errors import DataError

from ...scan_forms import INTRINSICS, look_along_x


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (" ".join(map(str, range(16))), np.arange(16.0).reshape(4, 4)),
        ("1 2 3\n4 5 6\n7 8 9\n", [[1, 2, 3, 0], [4, 5, 6, 0], [7, 8, 9, 0], [0, 0, 0, 1]]),
        ("-inf " * 16, np.full((4, 4), -np.inf)),
        ("1 2 3 4", None),
        ("", None),
        ("one " * 16, None),
        ("1\u00a02", None),
    ],
)
def test_matrices(tmp_path, text, expected) -> None:
    (tmp_path / "a.txt").write_text(text, encoding="utf-8")
    matrix = read_matrix(tmp_path / "a.txt")
    if expected is None:
        assert matrix is None
    else:
        np.testing.assert_array_equal(matrix, expected)


def test_a_file_without_end_is_not_read_whole(tmp_path) -> None:
    with (tmp_path / "a.txt").open("wb") as file:
        file.write(b"colorWidth = 640\n")
        file.truncate(1 << 42)
    assert read_matrix(tmp_path / "a.txt") is None
    assert read_header(tmp_path / "a.txt")["colorWidth"] == "640"


def test_no_file_is_no_matrix(tmp_path) -> None:
    assert read_matrix(tmp_path / "nowhere.txt") is None
    assert read_matrix(tmp_path) is None


def test_rigid_motions() -> None:
    pose = look_along_x(2.0)
    lost, mirrored, nan = np.full((4, 4), -np.inf), pose * np.array([-1, 1, 1, 1]), pose.copy()
    nan[0, 3] = np.nan
    poses = np.stack([pose, lost, np.zeros((4, 4)), mirrored, pose * 1.1, nan, np.eye(4)])
    assert are_rigid(poses).tolist() == [True, False, False, False, False, False, True]
    assert are_rigid(poses[:0]).tolist() == []


def test_header_lines_may_hold_anything(tmp_path) -> None:
    path = tmp_path / "scan.txt"
    path.write_bytes(b"a = 1 2\r\n\nnothing here\nsceneType = Bedroom / Hotel = \xff\n b=3 \n")
    assert read_header(path) == {"a": "1 2", "sceneType": "Bedroom / Hotel = \ufffd", "b": "3"}
    assert read_header(tmp_path / "nowhere.txt") == {}


def test_intrinsics_of_an_info_file(tmp_path) -> None:
    path = tmp_path / "_info.txt"
    words = " ".join(map(str, INTRINSICS.ravel()))
    path.write_text(f"m_colorWidth = 48\nm_calibrationColorIntrinsic = {words} \n")
    np.testing.assert_array_equal(read_intrinsics(path), INTRINSICS)
    path.write_text("m_calibrationColorIntrinsic = forty\n")
    with pytest.raises(DataError, match=r"_info\.txt does not hold a 4x4 or 3x3 camera matrix"):
        read_intrinsics(path)
    with pytest.raises(DataError, match=r"nowhere\.txt is missing"):
        read_intrinsics(tmp_path / "nowhere.txt")


@pytest.mark.parametrize("spoil", [np.nan, np.inf, 0.0, -40.0])
def test_focal_lengths_must_be_positive_numbers(tmp_path, spoil) -> None:
    matrix = INTRINSICS.copy()
    matrix[1, 1] = spoil
    with pytest.raises(DataError, match=r"k\.txt does not hold a camera matrix with positive focal lengths"):
        check_intrinsics(matrix, tmp_path / "k.txt", image_size=(32, 48), header={})


@pytest.mark.parametrize(
    ("header", "fits"),
    [
        ({}, True),
        ({"colorWidth": "48", "colorHeight": "32"}, True),
        ({"colorWidth": "0", "colorHeight": "0"}, True),
        ({"colorWidth": "forty", "colorHeight": "32"}, True),
        ({"colorWidth": "96", "colorHeight": "64"}, True),
        ({"colorWidth": "54", "colorHeight": "36"}, False),
    ],
)
def test_a_stated_size_that_fits_better_than_the_stored_one(tmp_path, header, fits) -> None:
    matrix = INTRINSICS.copy() if fits else INTRINSICS * np.array([[27 / 24], [18 / 16], [1], [1]])
    if fits:
        intrinsics = check_intrinsics(matrix, tmp_path / "k.txt", image_size=(32, 48), header=header)
        np.testing.assert_array_equal(intrinsics.numpy(), matrix[:3, :3])
    else:
        with pytest.raises(DataError, match=r"principal point at \(27\.0, 18\.0\).*than the stored 48x32"):
            check_intrinsics(matrix, tmp_path / "k.txt", image_size=(32, 48), header=header)


def test_a_camera_of_each_frame(tmp_path):
    path = tmp_path / "frames.txt"
    path.write_text("a b\t10 11 5 4\n2\t20 21 6 4\n")
    matrices, picture = read_frame_cameras(path, ["2", "a b"])
    assert matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]].tolist() == [[20, 21, 6, 4], [10, 11, 5, 4]]
    assert picture is None
    path.write_text("1\t10 11 5 4 0 2 10 8\n")
    assert read_frame_cameras(path, ["1"])[1].tolist() == [[0, 2, 10, 8]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 10 11 5 4", "has the line"),
        ("1\t10 11 5", "no frame with its camera"),
        ("1\t10 11 5 x", "has 'x' where a number is needed"),
        ("1\t0 11 5 4", "a focal length in"),
        ("1\t10 11 5 inf", "a pixel in"),
        ("2\t10 11 5 4", "has no line for frame 1"),
        ("1\t10 11 5 4 3 0 3 8", "shows nothing of its image"),
    ],
)
def test_damaged_cameras_of_frames(tmp_path, text, said):
    (tmp_path / "frames.txt").write_text(text)
    with pytest.raises(DataError, match=said):
        read_frame_cameras(tmp_path / "frames.txt", ["1"])
