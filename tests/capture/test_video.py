# SPDX-License-Identifier: Apache-2.0
"""A video with poses: the right frame at the right time, whatever the order in which frames are read."""

from __future__ import annotations

import sys
import wave

import numpy as np
import pytest
from PIL import Image

from raytran.capture.video import VideoFile, find_video, open_video, read_video
from raytran.errors import ConfigError, DataError

from .forms import tum_line, words, write_video

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
    with pytest.raises(ConfigError, match="PyAV, which is not installed: pip install av"):
        read_video(video)


def test_sound_alone_is_no_video(video):
    with wave.open(str(video / "walk.mp4"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(bytes(1000))
    with pytest.raises(DataError, match="has no pictures, only other streams: give a video"):
        read_video(video)
