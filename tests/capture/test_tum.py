# SPDX-License-Identifier: Apache-2.0
"""Images and a pose track, matched by time."""

from __future__ import annotations

import numpy as np
import pytest

from raytran.capture.imported import from_files
from raytran.capture.tum import is_tum, read_tum
from raytran.errors import DataError

from .forms import words, write_tum

TIMES = 1305031102.0 + 0.1 * np.arange(12)


@pytest.fixture
def folder(walk, tmp_path):
    write_tum(walk, tmp_path / "tum", TIMES)
    return tmp_path / "tum"


def test_images_get_the_poses_of_their_times(walk, folder):
    assert is_tum(folder)
    scan = from_files(read_tum(folder))
    assert scan.scene_id == "tum"
    assert scan.frame_id[1] == "1305031102.100000"
    np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses, atol=1e-9)
    assert scan.intrinsics.numpy()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == list(walk.camera)
    assert scan.read_color(7)[0, 0].tolist() == [140] * 3


def test_a_list_of_times_comes_before_names(walk, folder):
    names = sorted(path.name for path in (folder / "rgb").iterdir())
    # Named after each other, listed backwards.
    rows = [f"{time:.6f} rgb/{name}" for time, name in zip(TIMES[::-1], names, strict=True)]
    (folder / "rgb.txt").write_text("# color images\n" + "\n".join(rows) + "\n")
    scan = from_files(read_tum(folder))
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
    scan = from_files(read_tum(tmp_path / "tum"))
    assert scan.dropped == {f"{shifted[-1]:.6f}": "no pose"}
    middle = (walk.poses[3, :3, 3] + walk.poses[4, :3, 3]) / 2
    np.testing.assert_allclose(scan.world_from_camera[3, :3, 3], middle, atol=1e-6)


def test_poses_without_times_are_one_per_image(walk, folder):
    (folder / "trajectory.txt").write_text("\n".join(words(pose.ravel()) for pose in walk.poses))
    np.testing.assert_allclose(from_files(read_tum(folder)).world_from_camera.numpy(), walk.poses)
    (folder / "trajectory.txt").write_text("\n".join(words(pose.ravel()) for pose in walk.poses[1:]))
    with pytest.raises(
        DataError, match=r"has 12 images and 11 poses without times.*or a timestamp with each"
    ):
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
