# SPDX-License-Identifier: Apache-2.0
"""Pose tracks, the pose between two of them, and folders of images matched to one by time."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from raytran.capture.recording import open_recording
from raytran.capture.trajectory import (
    in_seconds,
    is_tum,
    poses_at,
    read_camera,
    read_track,
    read_tum,
    rotations,
)
from raytran.errors import DataError

from .forms import check_frames, tum_line, words, write_tum


@pytest.fixture
def turning():
    """Ten poses, a tenth of a second apart, of a camera that turns and moves evenly."""
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(np.arange(10), [0, 0, 0.1])).as_matrix()
    poses[:, :3, 3] = np.outer(np.arange(10), [0.1, 0.2, 0.3])
    return poses


@pytest.fixture
def track(turning, tmp_path):
    path = tmp_path / "trajectory.txt"
    # Not in the order of time, and with a comment.
    lines = [tum_line(5 + n / 10, pose) for n, pose in enumerate(turning)]
    path.write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines[::-1]) + "\n")
    return read_track(path)


def test_tum_lines_are_read_in_the_order_of_time(track, turning):
    np.testing.assert_allclose(track.times, 5 + np.arange(10) / 10)
    np.testing.assert_allclose(track.world_from_camera, turning, atol=1e-12)


def test_between_two_poses_the_pose_is_interpolated(track):
    poses = poses_at(track, np.array([5.25, 5.9, 4.998]))
    np.testing.assert_allclose(poses[0, :3, 3], [0.25, 0.5, 0.75])
    np.testing.assert_allclose(poses[0, :3, :3], Rotation.from_rotvec([0, 0, 0.25]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(poses[1], track.world_from_camera[9])
    # 2 ms before the first pose is its time.
    np.testing.assert_allclose(poses[2], track.world_from_camera[0])
    assert np.isnan(poses_at(track, np.array([4.9, 6.0]))).all()


def test_over_a_long_gap_there_is_no_pose(track, tmp_path):
    lines = (tmp_path / "trajectory.txt").read_text().splitlines()
    (tmp_path / "trajectory.txt").write_text("\n".join(lines[:4] + lines[8:]))
    poses = poses_at(read_track(tmp_path / "trajectory.txt"), np.array([5.0, 5.3, 5.75]))
    assert np.isfinite(poses).all(axis=(1, 2)).tolist() == [True, False, True]


def test_a_lost_pose_is_no_pose(track, tmp_path):
    text = (tmp_path / "trajectory.txt").read_text().splitlines()
    text[1] = text[1].split(" ")[0] + " nan nan nan 0 0 0 1"
    text[2] = " ".join(text[2].split(" ")[:4]) + " 0 0 0 0"
    (tmp_path / "trajectory.txt").write_text("\n".join(text))
    poses = poses_at(read_track(tmp_path / "trajectory.txt"), np.array([5.9, 5.8, 5.7]))
    assert np.isfinite(poses).all(axis=(1, 2)).tolist() == [False, False, True]


@pytest.mark.parametrize("rows", [3, 4])
def test_matrices_have_no_times(turning, tmp_path, rows):
    path = tmp_path / "poses.txt"
    path.write_text("\n".join(words(pose[:rows].ravel()) for pose in turning))
    track = read_track(path)
    assert track.times is None
    np.testing.assert_allclose(track.world_from_camera, turning)
    np.testing.assert_allclose(poses_at(track, np.array([3.0])), turning[3:4])


def test_nanoseconds_and_microseconds_are_told_by_their_size():
    assert in_seconds(np.array([1403636579763555584.0]))[0] == pytest.approx(1403636579.7635555, abs=1e-6)
    assert in_seconds(np.array([1403636579763555.0]))[0] == pytest.approx(1403636579.763555, abs=1e-6)
    assert in_seconds(np.array([1403636579.7, 0.5])).tolist() == [1403636579.7, 0.5]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no pose track: each line must hold `timestamp"),
        ("1 2 3\n", "is no pose track"),
        ("1 2 3 4 5 6 7 8\n1 2\n", "line 2 of .* does not hold numbers"),
        ("one 2 3 4 5 6 7 8\n", "line 1 of .* does not hold numbers"),
        ("\udcff", "no text in UTF-8"),
    ],
)
def test_what_is_no_track(tmp_path, text, message):
    (tmp_path / "a.txt").write_bytes(text.encode("utf-8", errors="surrogateescape"))
    with pytest.raises(DataError, match=message):
        read_track(tmp_path / "a.txt")


def test_intrinsics_in_every_form(tmp_path):
    path = tmp_path / "intrinsics.txt"
    expected = [50.0, 51.0, 31.0, 25.0]
    for text in (
        "50 51 31 25",
        "50, 51, 31, 25",
        "50 0 31\n0 51 25\n0 0 1",
        "50 0 31 0\n0 51 25 0\n0 0 1 0\n0 0 0 1",
    ):
        path.write_text(text)
        lens = read_camera(path, (48, 64))
        assert [*lens.focal, *lens.center] == expected
        assert lens.is_pinhole
    path.write_text("50 51 31 25 -0.1 0.02 0.003 0.004 0.005")
    lens = read_camera(path, (48, 64))
    assert (lens.model, lens.distortion) == ("FULL_OPENCV", (-0.1, 0.02, 0.003, 0.004, 0.005, 0, 0, 0))
    path.write_text("50 51")
    with pytest.raises(DataError, match="holds no intrinsics: write `fx fy cx cy` of the stored images"):
        read_camera(path, (48, 64))
    path.write_text("500 510 310 250")
    with pytest.raises(DataError, match=r"principal point at \(310\.0, 250\.0\).*of the stored images"):
        read_camera(path, (48, 64))


TIMES = 1305031102.0 + 0.1 * np.arange(12)


@pytest.fixture
def folder(walk, tmp_path):
    write_tum(walk, tmp_path / "tum", TIMES)
    return tmp_path / "tum"


def test_images_get_the_poses_of_their_times(walk, folder):
    assert is_tum(folder)
    scan = open_recording(read_tum(folder))
    assert scan.scene_id == "tum"
    assert scan.frame_id[1] == "1305031102.100000"
    np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses, atol=1e-9)
    assert scan.intrinsics[0].numpy()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == list(walk.camera)
    assert scan.read_color(7)[0, 0].tolist() == [140] * 3


def test_a_list_of_times_comes_before_names(walk, folder):
    names = sorted(path.name for path in (folder / "rgb").iterdir())
    # Named after each other, listed backwards.
    rows = [f"{time:.6f} rgb/{name}" for time, name in zip(TIMES[::-1], names, strict=True)]
    (folder / "rgb.txt").write_text("# color images\n" + "\n".join(rows) + "\n")
    scan = open_recording(read_tum(folder))
    np.testing.assert_allclose(scan.world_from_camera.numpy()[::-1], walk.poses, atol=1e-9)
    (folder / "rgb.txt").write_text("1305031102.0 ../secret.png\n")
    with pytest.raises(DataError, match="which is outside"):
        read_tum(folder)
    (folder / "rgb.txt").write_text("1305031102.0\n")
    with pytest.raises(DataError, match="does not hold `timestamp file` lines"):
        read_tum(folder)


def test_images_between_poses_are_interpolated_and_others_counted(walk, tmp_path):
    shifted = TIMES + 0.05
    write_tum(walk, tmp_path / "tum", TIMES, image_times=shifted)
    scan = open_recording(read_tum(tmp_path / "tum"))
    assert scan.dropped == {f"{shifted[-1]:.6f}": "no pose"}
    middle = (walk.poses[3, :3, 3] + walk.poses[4, :3, 3]) / 2
    np.testing.assert_allclose(scan.world_from_camera[3, :3, 3], middle, atol=1e-6)


def test_poses_without_times_are_one_per_image(walk, folder):
    (folder / "trajectory.txt").write_text("\n".join(words(pose.ravel()) for pose in walk.poses))
    np.testing.assert_allclose(open_recording(read_tum(folder)).world_from_camera.numpy(), walk.poses)
    (folder / "trajectory.txt").write_text("\n".join(words(pose.ravel()) for pose in walk.poses[2:]))
    with pytest.raises(DataError, match=r"12 images and 10 poses without times.*or a timestamp with each"):
        read_tum(folder)


def test_what_is_missing_is_named(walk, folder):
    (folder / "intrinsics.txt").unlink()
    with pytest.raises(DataError, match=r"has no intrinsics\.txt: write `fx fy cx cy`"):
        read_tum(folder)
    for path in (folder / "rgb").iterdir():
        path.rename(path.with_name("a" + path.name + "b.png"))
    with pytest.raises(DataError, match="has no time in its name: name images by the track's timestamps"):
        read_tum(folder)
    for path in (folder / "rgb").iterdir():
        path.unlink()
    with pytest.raises(DataError, match="has no images: put them in its folder rgb"):
        read_tum(folder)
    (folder / "trajectory.txt").unlink()
    with pytest.raises(DataError, match=r"has no pose track: wanted is one of trajectory\.txt"):
        read_tum(folder)


def test_clocks_that_differ_are_one_sentence(walk, tmp_path):
    write_tum(walk, tmp_path / "tum", TIMES, image_times=TIMES - 1305031102)
    with pytest.raises(
        DataError, match=r"none of the 12 images of .* has a pose at its time among the 12 of"
    ):
        read_tum(tmp_path / "tum")


def name_images(walk, folder, names, times, poses=None):
    """Write a TUM folder whose images are named otherwise than by the times of the track."""
    write_tum(walk, folder, times)
    for path in (folder / "rgb").iterdir():
        path.unlink()
    for name, new in zip(walk.names, names, strict=True):
        (folder / "rgb" / new).write_bytes((walk.folder / "images" / name).read_bytes())
    if poses is not None:
        (folder / "trajectory.txt").write_text(
            "\n".join(tum_line(t, p) for t, p in zip(times, poses, strict=True))
        )
    return folder


@pytest.mark.parametrize("first", [0, 1])
def test_numbered_images_get_the_poses_of_a_track_in_seconds_if_there_are_as_many(
    walk, tmp_path, first, caplog
):
    names = [f"frame_{n + first:05d}.png" for n in range(12)]
    folder = name_images(walk, tmp_path / "tum", names, np.arange(12) / 10)
    check_frames(open_recording(read_tum(folder)), walk)
    assert "its images are numbered, not named by times" in caplog.text


@pytest.mark.parametrize(
    ("numbers", "times"),
    [
        (range(12), np.arange(40) / 10),  # 12 of 40 frames at 10 Hz: which?
        (range(12), np.arange(4.0)),  # image n is no second n: they outrun the track
        (range(0, 120, 10), np.arange(120) / 30),  # every tenth frame
        (range(1, 13), np.arange(120) / 10),
    ],
)
def test_frame_numbers_are_no_seconds(walk, tmp_path, numbers, times):
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    folder = name_images(walk, tmp_path / "tum", [f"{n:04d}.png" for n in numbers], np.arange(12), None)
    (folder / "trajectory.txt").write_text(
        "\n".join(tum_line(t, p) for t, p in zip(times, poses, strict=True))
    )
    with pytest.raises(DataError, match=r"are numbered, and which has which of the \d+ times in traj"):
        read_tum(folder)


def test_whole_numbers_that_the_track_has_too_are_its_own(walk, tmp_path):
    # A track of frame numbers, from 1; and one of the key frames among the images.
    folder = name_images(walk, tmp_path / "a", [f"{n + 1}.png" for n in range(12)], np.arange(1, 13))
    check_frames(open_recording(read_tum(folder)), walk)
    folder = name_images(walk, tmp_path / "b", [f"{n}.png" for n in range(12)], np.arange(12))
    lines = (folder / "trajectory.txt").read_text().splitlines()[1:]
    (folder / "trajectory.txt").write_text("\n".join(lines[n] for n in (0, 3, 4, 10)))
    scan = open_recording(read_tum(folder))
    check_frames(scan, walk, [0, 3, 4, 10])
    assert len(scan.dropped) == 8


@pytest.mark.parametrize("unit", [1, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("track_unit", [1, 1e3, 1e6, 1e9])
def test_times_since_1970_in_any_unit_on_either_side(walk, tmp_path, unit, track_unit):
    seconds = 1680000000 + np.arange(12)
    names = [f"{int((time + 0.003) * unit)}.png" if unit > 1 else f"{time}.png" for time in seconds]
    folder = name_images(walk, tmp_path / "tum", names, seconds * track_unit)
    check_frames(open_recording(read_tum(folder)), walk)


def test_one_pose_or_image_more_is_the_last(walk, folder, caplog):
    poses = np.concatenate([walk.poses, walk.poses[:1]])
    (folder / "trajectory.txt").write_text("\n".join(words(pose.ravel()) for pose in poses))
    for n, path in enumerate(sorted((folder / "rgb").iterdir())):
        path.rename(path.with_name(f"{n:06d}.png"))
    scan = open_recording(read_tum(folder))
    check_frames(scan, walk)
    assert "the last pose has no partner" in caplog.text
    (folder / "trajectory.txt").write_text("\n".join(words(pose.ravel()) for pose in walk.poses[:11]))
    scan = open_recording(read_tum(folder))
    check_frames(scan, walk, range(11))
    assert scan.dropped == {"000011": "no pose"}
    # If one in between is missing, the numbers of the others tell.
    (folder / "rgb" / "000005.png").unlink()
    (folder / "trajectory.txt").write_text("\n".join(words(pose.ravel()) for pose in walk.poses))
    check_frames(open_recording(read_tum(folder)), walk, [n for n in range(12) if n != 5])
    # Of images from 1 it is not known whether the first or the last is missing.
    (folder / "rgb" / "000000.png").unlink()
    with pytest.raises(DataError, match="10 images and 12 poses without times, so what belongs together"):
        read_tum(folder)


def write_replica(walk, folder, *, above):
    """Replica as SLAM programs use it."""
    (folder / "results").mkdir(parents=True)
    for n, name in enumerate(walk.names):
        (folder / "results" / f"frame{n:06d}.png").write_bytes((walk.folder / "images" / name).read_bytes())
        (folder / "results" / f"depth{n:06d}.png").write_bytes(b"depth")
    (folder / "traj.txt").write_text("\n".join(words(pose.ravel()) for pose in walk.poses) + "\n")
    fx, fy, cx, cy = walk.camera
    camera = {"w": 64, "h": 48, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "scale": 6553.5}
    ((folder.parent if above else folder) / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


@pytest.mark.parametrize("above", [True, False])
def test_replica(walk, tmp_path, above):
    folder = write_replica(walk, tmp_path / "replica" / "office0", above=above)
    assert is_tum(folder)
    scan = open_recording(read_tum(folder))
    assert scan.scene_id == "office0"
    check_frames(scan, walk)
    assert scan.lens[0].focal == (50.0, 51.0)
    assert scan.dropped == {}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("separator", [" ", ",", "; ", "\t"])
def test_tracks_as_spreadsheets_write_them(walk, folder, encoding, separator):
    lines = (folder / "trajectory.txt").read_text().splitlines()[1:]
    text = "\r\n".join(line.replace(" ", separator) for line in ["timestamp tx ty tz qx qy qz qw", *lines])
    (folder / "trajectory.txt").write_text(text, encoding=encoding)
    check_frames(open_recording(read_tum(folder)), walk)


def test_a_damaged_line_is_a_lost_pose(walk, tmp_path, caplog):
    folder = tmp_path / "slow"
    write_tum(walk, folder, 0.5 + np.arange(12))
    lines = (folder / "trajectory.txt").read_text().splitlines()
    lines[4] = "tracking lost"
    (folder / "trajectory.txt").write_text("\n".join(lines))
    scan = open_recording(read_tum(folder))
    check_frames(scan, walk, [n for n in range(12) if n != 3])
    assert "1 of 12 lines hold no pose and are left out" in caplog.text


def test_images_of_other_kinds_and_files_of_macos(walk, folder):
    for path in list((folder / "rgb").iterdir()):
        with Image.open(path) as image:
            image.save(path.with_suffix(".webp"), lossless=True)
        path.unlink()
        path.with_name(f"._{path.stem}.webp").write_bytes(b"Mac OS X")
    scan = open_recording(read_tum(folder))
    assert len(scan) == 12
    assert scan.dropped == {}


def test_a_list_may_spell_images_otherwise(walk, folder):
    names = sorted(path.name for path in (folder / "rgb").iterdir())
    rows = [f"{time:.6f} rgb\\{name.upper()}" for time, name in zip(TIMES, names, strict=True)]
    (folder / "rgb.txt").write_text("\n".join(rows) + "\n", encoding="utf-8-sig")
    check_frames(open_recording(read_tum(folder)), walk)


def test_typed_intrinsics_come_first(walk, folder):
    (folder / "intrinsics.txt").unlink()
    with pytest.raises(DataError, match="or give intrinsics=fx,fy,cx,cy"):
        read_tum(folder)
    scan = open_recording(read_tum(folder, walk.camera))
    assert scan.lens[0].focal == (50.0, 51.0)
    with pytest.raises(DataError, match=r"intrinsics=5,5,310,250 has its principal point at"):
        read_tum(folder, (5, 5, 310, 250))


def test_images_without_a_time_and_damaged_lines_are_left_out(walk, tmp_path, caplog):
    folder = tmp_path / "slow"
    write_tum(walk, folder, 0.5 + np.arange(12))
    (folder / "rgb" / "cover.png").write_bytes(b"")
    scan = open_recording(read_tum(folder))
    assert scan.dropped == {"cover": "no time in its name"}
    check_frames(scan, walk)
    rows = [f"{n + 0.5} rgb/{n + 0.5:.6f}.png" for n in range(12)]
    rows[4] = "lost"
    (folder / "rgb.txt").write_text("\n".join(["time file", *rows]))
    check_frames(open_recording(read_tum(folder)), walk, [n for n in range(12) if n != 4])
    assert "1 of 12 lines are damaged and left out" in caplog.text


def test_numbers_beyond_all_quaternions_are_lost_poses_without_a_warning(recwarn):
    quaternions = np.array(
        [[0.0, 0, 0, 1], [1e300, 0, 0, 1], [np.nan, 0, 0, 1], [0.1, 0, 0, 1.05], [0, 0, 0, 0]]
    )
    assert np.isfinite(rotations(quaternions)).all(axis=(1, 2)).tolist() == [True, False, False, True, False]
    assert not recwarn.list
