# SPDX-License-Identifier: Apache-2.0
"""ARKit's logs: two apps' and a data set's."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from raytran.capture.arkit import find_log, read_arkit
from raytran.capture.recording import open_recording
from raytran.errors import DataError

from .forms import OPENGL, words

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""y-up world from the walk's."""


def write_scanner(walk, folder):
    """3D Scanner App, "all data"."""
    folder.mkdir()
    fx, fy, cx, cy = walk.camera
    for n, pose in enumerate(walk.poses):
        content = {
            "cameraPoseARFrame": (Y_UP @ pose @ OPENGL).ravel().tolist(),
            "intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1],
            "time": n / 10,
        }
        (folder / f"frame_{n:05d}.json").write_text(json.dumps(content))
        (folder / f"frame_{n:05d}.png").write_bytes((walk.folder / "images" / f"{n}.png").read_bytes())
    (folder / "info.json").write_text("{}")
    return folder


def write_polycam(walk, folder):
    """Polycam, "raw data"."""
    fx, fy, cx, cy = walk.camera
    for part in ("cameras", "images"):
        (folder / "keyframes" / part).mkdir(parents=True)
    for n, pose in enumerate(walk.poses):
        matrix = Y_UP @ pose @ OPENGL
        content = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        content |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": 64, "height": 48}
        (folder / "keyframes" / "cameras" / f"{1000 + n}.json").write_text(json.dumps(content))
        image = (walk.folder / "images" / f"{n}.png").read_bytes()
        (folder / "keyframes" / "images" / f"{1000 + n}.png").write_bytes(image)
    return folder


def write_arkitscenes(walk, folder):
    """ARKitScenes: a track of camera-from-world, intrinsics a millisecond off."""
    inner = folder / "41254925_frames"
    for part in ("lowres_wide", "lowres_wide_intrinsics"):
        (inner / part).mkdir(parents=True)
    rows = []
    for n, pose in enumerate(walk.poses):
        time = 3211.4 + n / 10
        inverse = np.linalg.inv(pose)
        turn = Rotation.from_matrix(inverse[:3, :3]).as_rotvec()
        rows.append(f"{time} {words(turn)} {words(inverse[:3, 3])}")
        image = (walk.folder / "images" / f"{n}.png").read_bytes()
        (inner / "lowres_wide" / f"41254925_{time:.3f}.png").write_bytes(image)
        pincam = inner / "lowres_wide_intrinsics" / f"41254925_{time + 0.001:.3f}.pincam"
        pincam.write_text("64 48 " + words(walk.camera))
    (inner / "lowres_wide.traj").write_text("\n".join(rows) + "\n")
    return folder


WRITERS = {"scanner": write_scanner, "polycam": write_polycam, "arkitscenes": write_arkitscenes}


@pytest.mark.parametrize("name", WRITERS)
def test_a_log_is_read(walk, name):
    folder = WRITERS[name](walk, walk.folder.parent / "log")
    source = read_arkit(folder)
    assert source.metric
    assert source.scene_id == "log"
    scan = open_recording(source)
    poses = scan.world_from_camera.numpy()
    if name == "arkitscenes":
        assert (source.axes, source.up) == ("opencv", (0.0, 0.0, 1.0))
        np.testing.assert_allclose(poses, walk.poses, atol=1e-9)
    else:
        assert (source.axes, source.up) == ("opengl", (0.0, 1.0, 0.0))
        np.testing.assert_allclose(poses @ OPENGL, Y_UP @ walk.poses, atol=1e-9)
    assert scan.intrinsics[0].numpy()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == list(walk.camera)
    assert [int(scan.read_color(n)[0, 0, 0]) for n in (0, 10)] == [0, 200]


def test_images_and_logs_without_each_other_are_counted(walk):
    folder = write_scanner(walk, walk.folder.parent / "log")
    (folder / "frame_00003.json").unlink()
    (folder / "frame_00005.png").unlink()
    assert open_recording(read_arkit(folder)).dropped == {"frame_00003": "no pose", "frame_00005": "no image"}


def test_images_without_a_pose_or_intrinsics_near_are_counted(walk):
    folder = write_arkitscenes(walk, walk.folder.parent / "log")
    track = folder / "41254925_frames" / "lowres_wide.traj"
    track.write_text("\n".join(track.read_text().splitlines()[:9]))
    next((folder / "41254925_frames" / "lowres_wide_intrinsics").glob("*_3211.701.*")).unlink()
    dropped = open_recording(read_arkit(folder)).dropped
    assert dropped == {
        f"41254925_{time}": "no pose" for time in ("3211.700", "3212.300", "3212.400", "3212.500")
    }


def test_corrected_keyframes_come_first(walk):
    folder = write_polycam(walk, walk.folder.parent / "log")
    assert find_log(folder) == folder / "keyframes" / "cameras"
    for part in ("cameras", "images"):
        (folder / "keyframes" / f"corrected_{part}").mkdir()
    assert find_log(folder) == folder / "keyframes" / "corrected_cameras"


def test_what_is_wrong_is_named(walk):
    folder = write_scanner(walk, walk.folder.parent / "log")
    (folder / "frame_00004.json").write_text('{"intrinsics": [1]}')
    with pytest.raises(
        DataError, match=r"frame_00004\.json has no cameraPoseARFrame where numbers are needed"
    ):
        read_arkit(folder)
    scenes = write_arkitscenes(walk, walk.folder.parent / "scenes") / "41254925_frames"
    next((scenes / "lowres_wide_intrinsics").iterdir()).write_text("64 48")
    with pytest.raises(DataError, match="does not hold `width height fx fy cx cy`"):
        read_arkit(scenes)
    (scenes / "lowres_wide.traj").write_text("1 2 3\n")
    with pytest.raises(DataError, match="does not hold a time, a turn and a shift in each line"):
        read_arkit(scenes.parent)
    assert find_log(walk.folder) is None
    with pytest.raises(DataError, match=r"holds no ARKit log: wanted are frame_\*\.json"):
        read_arkit(walk.folder)
