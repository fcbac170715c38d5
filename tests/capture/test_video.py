# SPDX-License-Identifier: Apache-2.0
"""A video with poses: the right frame at the right time, whatever the order in which frames are read."""

from __future__ import annotations

import sys
import wave
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from raytran.capture.open import open_scene
from raytran.capture.orientation import WorldSettings
from raytran.capture.video import VideoFile, _numbers_of_poses, find_video, open_video, read_video
from raytran.data.images import turned_image
from raytran.errors import ConfigError, DataError

from .forms import DISPLAY_MATRICES, tum_line, words, write_video

pytest.importorskip("av", reason="PyAV, the reader of videos, is not installed")


@pytest.fixture
def video(walk, tmp_path):
    """A folder with ``walk.mp4``, ten frames a second, poses with times, and intrinsics."""
    folder = tmp_path / "video"
    folder.mkdir()
    write_video(walk, folder / "walk.mp4")
    lines = [tum_line(n / 10, pose) for n, pose in enumerate(walk.poses)]
    (folder / "walk.txt").write_text("\n".join(lines))
    (folder / "intrinsics.txt").write_text(words(walk.camera))
    return folder


def test_frames_and_poses_belong_together(walk, video):
    with open_video(read_video(video)) as scan:
        assert scan.scene_id == "walk"
        assert scan.path == video / "walk.mp4"
        assert scan.frame_id == tuple(str(n) for n in range(12))
        np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses, atol=1e-9)
        assert scan.image_size == (48, 64)
        assert scan.color_bytes(3) is None
        # Forwards, backwards, twice, over key frames: the grey tells the number.
        for n in (0, 1, 7, 3, 3, 11, 2, 10):
            image = scan.read_color(n)
            assert image.shape == (48, 64, 3)
            assert abs(image.mean() - 20 * n) < 4
        assert scan.read_color(5, (24, 32)).shape == (24, 32, 3)


def test_frames_without_a_pose_are_counted(walk, video):
    lines = (video / "walk.txt").read_text().splitlines()
    (video / "walk.txt").write_text("\n".join(lines[:6]))
    with open_video(read_video(video)) as scan:
        assert len(scan) == 6
        assert set(scan.dropped.values()) == {"no pose"}
        assert list(scan.dropped) == [str(n) for n in range(6, 12)]


def test_poses_without_times_are_one_per_frame(walk, video):
    (video / "walk.txt").write_text("\n".join(words(pose.ravel()) for pose in walk.poses))
    with open_video(read_video(video / "walk.mp4")) as scan:
        np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses)
    (video / "walk.txt").write_text("\n".join(words(pose.ravel()) for pose in walk.poses[:9]))
    with pytest.raises(
        DataError, match=r"has 12 frames and walk\.txt 9 poses without times: give one per frame"
    ):
        read_video(video)


def test_poses_at_other_times_are_refused(walk, video):
    lines = [tum_line(1305031102 + n / 10, pose) for n, pose in enumerate(walk.poses)]
    (video / "walk.txt").write_text("\n".join(lines))
    with pytest.raises(
        DataError, match=r"lasts from 0 to 1\.1 s and the poses .* from 1305031102\.0 to .*since the"
    ):
        read_video(video)


def test_what_is_missing_is_named(video):
    (video / "intrinsics.txt").unlink()
    with pytest.raises(
        DataError, match=r"has no intrinsics beside it: write `fx fy cx cy` to .*walk\.intrinsics"
    ):
        read_video(video)
    (video / "walk.txt").unlink()
    with pytest.raises(
        DataError, match=r"has no pose track beside it: write `timestamp tx .* to .*walk\.txt"
    ):
        read_video(video)
    (video / "second.mov").touch()
    assert find_video(video) is None
    with pytest.raises(DataError, match="is or holds no single video"):
        read_video(video)


@pytest.mark.parametrize("content", [b"", b"no video", b"\0" * 5000])
def test_what_is_no_video(video, content):
    (video / "walk.mp4").write_bytes(content)
    with pytest.raises(DataError, match=r"cannot read the video .*walk\.mp4 .*: copy or export it again"):
        read_video(video)


def test_a_video_that_was_cut_short(video):
    whole = (video / "walk.mp4").read_bytes()
    (video / "walk.mp4").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"walk\.mp4"):
        read_video(video)


def test_damaged_frames_are_errors_of_those_frames(walk, video):
    noise = np.random.default_rng(0).integers(0, 255, (12, 48, 64, 3), dtype=np.uint8)
    for name, pixels in zip(walk.names, noise, strict=True):
        Image.fromarray(pixels).save(walk.folder / "images" / name)
    write_video(walk, video / "walk.mp4")
    raw = bytearray((video / "walk.mp4").read_bytes())
    start = raw.find(b"mdat")
    size = int.from_bytes(raw[start - 4 : start], "big")
    raw[start + size // 2 : start + size - 8] = bytes(size - 8 - size // 2)
    (video / "walk.mp4").write_bytes(raw)
    messages = {}
    with open_video(read_video(video)) as scan:
        for n in range(12):
            try:
                assert scan.read_color(n).shape == (48, 64, 3)
            except DataError as error:
                messages[n] = str(error)
    assert 0 not in messages
    assert 11 in messages
    assert all("walk.mp4" in message and "export it again" in message for message in messages.values())


def test_frames_that_claim_to_be_huge_are_refused(video, monkeypatch):
    monkeypatch.setattr("raytran.capture.video.MAX_SIDE", 40)
    with pytest.raises(DataError, match="claims frames of 64x48, and 1 to 40 pixels a side are read: export"):
        VideoFile(video / "walk.mp4")


def test_without_pyav_it_is_said_what_to_install(video, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ConfigError, match=r"PyAV, which is not installed: pip install 'raytran\[video\]'"):
        read_video(video)


def test_sound_alone_is_no_video(video):
    with wave.open(str(video / "walk.mp4"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(bytes(1000))
    with pytest.raises(DataError, match="has no pictures, only other streams: give a video"):
        read_video(video)


UNDO = {2: 2, 3: 3, 4: 4, 6: 8, 8: 6}
"""EXIF orientation → the one that turns back."""

BLIND = WorldSettings(check=False)


def colored(walk, turn=1):
    """Write images of four colours, one a quarter; return that of frame 0 before it was turned back."""
    shown = np.kron(
        np.array([[[200, 40, 40], [40, 200, 40]], [[40, 40, 200], [220, 220, 220]]]), np.ones((24, 32, 1))
    )
    shown = shown.astype(np.uint8)
    for name in walk.names:
        Image.fromarray(turned_image(shown, UNDO[turn]) if turn != 1 else shown).save(
            walk.folder / "images" / name
        )
    return shown


@pytest.mark.parametrize("turn", DISPLAY_MATRICES)
def test_frames_are_turned_as_they_are_displayed_and_poses_belong_to_them(walk, video, caplog, turn):
    shown = colored(walk, turn)
    coded = shown.shape[:2] if turn < 5 else shown.shape[1::-1]
    write_video(walk, video / "walk.mp4", turn=turn, size=coded)
    caplog.set_level("INFO")
    with open_scene(video, settings=BLIND) as scan:
        assert scan.image_size == (48, 64)
        np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses, atol=1e-9)
        assert scan.intrinsics[4, :2, 2].tolist() == list(walk.camera[2:])
        for n in (0, 7, 3):
            assert np.abs(scan.read_color(n).astype(int) - shown).mean() < 6
        assert scan.read_color(2, (24, 32)).shape == (24, 32, 3)
    assert (
        "of 12 images by what their files say; poses are taken to be those of the images as shown"
        in caplog.text
    )


@pytest.mark.parametrize("turn", [6, 8])
def test_intrinsics_of_the_coded_frames_are_told_by_their_aspect_and_up_turns_the_pictures(
    walk, video, caplog, turn
):
    """Cameras of frames as they are coded: on their side, as the phone that was held upright filmed them."""
    shown = colored(walk, turn)
    write_video(walk, video / "walk.mp4", turn=turn, size=(64, 48))
    fx, fy, cx, cy = walk.camera
    (video / "intrinsics.txt").write_text(words((fy, fx, *((cy, 64 - cx) if turn == 6 else (48 - cy, cx)))))
    side = (
        np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
        if turn == 6
        else np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])
    )
    poses = walk.poses.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ side
    (video / "walk.txt").write_text("\n".join(tum_line(n / 10, pose) for n, pose in enumerate(poses)))
    caplog.set_level("INFO")
    with open_scene(video, settings=BLIND) as scan:
        assert scan.image_size == (48, 64)
        np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses, atol=1e-9)
        np.testing.assert_allclose(scan.intrinsics[4, :2, 2], walk.camera[2:], atol=1e-9)
        assert np.abs(scan.read_color(5).astype(int) - shown).mean() < 6
    assert "those of the images as stored, as their intrinsics have it" in caplog.text


def test_a_video_that_is_not_turned_says_nothing_of_it(video, caplog):
    caplog.set_level("INFO")
    with open_scene(video, settings=BLIND) as scan:
        assert scan.images.tags is None
    assert "images by what" not in caplog.text


UNEVEN = np.cumsum([0, 30, 34, 90, 33, 33, 60, 31, 36, 120, 33, 33])
"""Milliseconds at which a phone took twelve frames, with some lost in the dark."""


def test_times_of_a_variable_rate_are_those_at_which_frames_are_shown(walk, video):
    write_video(walk, video / "walk.mp4", times=UNEVEN)
    lines = [tum_line(time / 1000, pose) for time, pose in zip(UNEVEN, walk.poses, strict=True)]
    (video / "walk.txt").write_text("\n".join(lines))
    with open_video(read_video(video)) as scan:
        np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses, atol=1e-6)
        for n in (0, 11, 5):
            assert abs(scan.read_color(n).mean() - 20 * n) < 4
    # Poses without times are one per frame, whatever their rate.
    (video / "walk.txt").write_text("\n".join(words(pose.ravel()) for pose in walk.poses))
    np.testing.assert_allclose(open_video(read_video(video)).world_from_camera.numpy(), walk.poses)


@pytest.mark.parametrize(
    ("rate", "start", "kept"),
    [(30, 0, range(12)), (30, 1, range(12)), (25, 0, range(12)), (30, 0, [0, 1, 2, 5, 6, 7, 8, 10, 11])],
)
def test_poses_at_a_constant_rate_beside_a_variable_one_are_matched_by_number(
    walk, video, caplog, rate, start, kept
):
    write_video(walk, video / "walk.mp4", times=UNEVEN)
    lines = [tum_line((n + start) / rate, walk.poses[n]) for n in kept]
    (video / "walk.txt").write_text("\n".join(lines))
    with open_video(read_video(video)) as scan:
        assert scan.frame_id == tuple(map(str, kept))
        np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses[list(kept)], atol=1e-6)
    assert f"the poses in walk.txt, {len(kept)} for 12 frames: they are matched by number" in caplog.text


def test_a_tracker_of_its_own_rate_is_matched_by_time(walk, video, caplog):
    """A hundred poses a second beside frames of variable rate: each frame gets the pose of its time."""
    write_video(walk, video / "walk.mp4", times=UNEVEN)
    fine = replace(walk, poses=np.repeat(walk.poses[:1], 60, axis=0))
    fine.poses[:, 0, 3] = np.arange(60) * 0.01
    (video / "walk.txt").write_text("\n".join(tum_line(n / 100, pose) for n, pose in enumerate(fine.poses)))
    with open_video(read_video(video)) as scan:
        np.testing.assert_allclose(scan.world_from_camera[:, 0, 3].numpy(), UNEVEN / 1000, atol=0.006)
    assert "matched by number" not in caplog.text


def test_a_rate_that_was_told_wrong_is_matched_by_number(walk, video, caplog):
    """A track at 12 poses a second of a video with ten frames a second, one pose each."""
    (video / "walk.txt").write_text("\n".join(tum_line(n / 12, pose) for n, pose in enumerate(walk.poses)))
    with open_video(read_video(video)) as scan:
        np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses, atol=1e-6)
    assert "matched by number" in caplog.text


def test_times_of_no_video_are_no_frame_numbers(recwarn):
    times = np.arange(12) / 10
    for odd in (1e20, 1e300):
        assert _numbers_of_poses(np.append(times[:-1], odd), times) is None
    assert not recwarn.list
