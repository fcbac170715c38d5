# SPDX-License-Identifier: Apache-2.0
"""ARKit's logs: two apps' and a data set's."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from raytran.capture.arkit import find_log, read_arkit
from raytran.capture.recording import open_recording
from raytran.errors import DataError

from .forms import OPENGL, Y_UP, check_frames, words


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
    # They are empty in a capture that was not optimised.
    assert find_log(folder) == folder / "keyframes" / "cameras"
    for part in ("cameras", "images"):
        shutil.copytree(
            folder / "keyframes" / part, folder / "keyframes" / f"corrected_{part}", dirs_exist_ok=True
        )
    assert find_log(folder) == folder / "keyframes" / "corrected_cameras"


def test_what_is_wrong_is_named(walk):
    folder = write_scanner(walk, walk.folder.parent / "log")
    for n in range(12):
        (folder / f"frame_{n:05d}.json").write_text('{"intrinsics": [1]}')
    with pytest.raises(
        DataError, match=r"frame_00000\.json has no cameraPoseARFrame where numbers are needed"
    ):
        read_arkit(folder)
    scenes = write_arkitscenes(walk, walk.folder.parent / "scenes") / "41254925_frames"
    for path in (scenes / "lowres_wide_intrinsics").iterdir():
        path.write_text("64 48")
    with pytest.raises(DataError, match="does not hold `width height fx fy cx cy`"):
        read_arkit(scenes)
    (scenes / "lowres_wide.traj").write_text("1 2 3\n")
    with pytest.raises(DataError, match="does not hold a time, a turn and a shift in each line"):
        read_arkit(scenes.parent)
    assert find_log(walk.folder) is None
    with pytest.raises(DataError, match=r"holds no ARKit log: wanted are frame_\*\.json"):
        read_arkit(walk.folder)


def check_log(folder, walk, numbers=None, **options):
    """Read a log whose world is +y up, and hold its frames against the walk's."""
    scan = open_recording(read_arkit(folder, **options))
    scan = replace(scan, world_from_camera=scan.world_from_camera @ torch.from_numpy(OPENGL))
    check_frames(scan, walk, numbers, turn=Y_UP)
    return scan


@pytest.mark.parametrize("has_cameras", [True, False])
def test_polycam_since_2025_does_not_state_the_size_of_corrected_images(walk, has_cameras):
    folder = write_polycam(walk, walk.folder.parent / "log") / "keyframes"
    for part in ("cameras", "images"):
        shutil.copytree(folder / part, folder / f"corrected_{part}")
    for path in (folder / "corrected_cameras").iterdir():
        content = json.loads(path.read_text())
        path.write_text(json.dumps({k: v for k, v in content.items() if k not in ("width", "height")}))
    if not has_cameras:
        shutil.rmtree(folder / "cameras")
    scan = check_log(folder.parent, walk)
    assert scan.lens[0].size == (48, 64)


def test_files_of_macos_are_ignored(walk):
    for name in ("scanner", "polycam"):
        folder = WRITERS[name](walk, walk.folder.parent / name)
        for path in [*folder.rglob("*.json"), *folder.rglob("*.png")]:
            path.with_name(f"._{path.name}").write_bytes(b"Mac OS X")
        assert check_log(folder, walk).dropped == {}
    folder = write_arkitscenes(walk, walk.folder.parent / "arkitscenes")
    for path in [*folder.rglob("*.png"), *folder.rglob("*.pincam")]:
        path.with_name(f"._{path.name}").write_bytes(b"Mac OS X")
    (folder / "._41254925_frames").mkdir()
    check_frames(open_recording(read_arkit(folder)), walk)


@pytest.mark.parametrize("images", ["vga_wide", "wide"])
def test_arkitscenes_without_its_smallest_images(walk, images):
    frames = write_arkitscenes(walk, walk.folder.parent / "log") / "41254925_frames"
    (frames / "lowres_wide").rename(frames / images)
    # Their own intrinsics, or those of the small images, which say for which size they are.
    check_frames(open_recording(read_arkit(frames)), walk)
    (frames / "lowres_wide_intrinsics").rename(frames / f"{images}_intrinsics")
    check_frames(open_recording(read_arkit(frames)), walk)


def test_images_at_60_hz_beside_poses_at_10_hz(walk):
    """A walk on a straight line: where the camera is between two poses is known exactly."""
    frames = write_arkitscenes(walk, walk.folder.parent / "log") / "41254925_frames"
    rows = (frames / "lowres_wide.traj").read_text().splitlines()
    turn = " ".join(rows[0].split()[1:4])
    (frames / "lowres_wide.traj").write_text(
        "\n".join(f"{row.split()[0]} {turn} {0.06 * n} 0 0" for n, row in enumerate(rows))
    )
    image = next((frames / "lowres_wide").iterdir()).read_bytes()
    shutil.rmtree(frames / "lowres_wide")
    (frames / "vga_wide").mkdir()
    times = 3211.4 + np.arange(67) / 60
    for time in times:
        (frames / "vga_wide" / f"41254925_{time + 0.003:.3f}.png").write_bytes(image)
    scan = open_recording(read_arkit(frames))
    assert len(scan) == 67
    rotation = Rotation.from_rotvec(np.array(turn.split(), dtype=float)).as_matrix()
    shift = -scan.world_from_camera.numpy()[:, :3, 3] @ rotation.T
    expected = np.clip(0.6 * (times + 0.003 - 3211.4), 0, 0.66)
    np.testing.assert_allclose(shift[:, 0], expected, atol=0.004)


def test_damage_to_one_frame_leaves_that_one_out(walk):
    folder = write_polycam(walk, walk.folder.parent / "log")
    cameras = folder / "keyframes" / "cameras"
    (cameras / "1002.json").write_text("{")
    for name, key, value in (("1003", "t_00", "north"), ("1004", "fx", 0), ("1005", "width", 10**30)):
        content = json.loads((cameras / f"{name}.json").read_text()) | {key: value}
        (cameras / f"{name}.json").write_text(json.dumps(content))
    assert check_log(folder, walk, [0, 1, 6, 7, 8, 9, 10, 11]).dropped == {
        "1002": "entry is damaged",
        "1003": "no camera-to-world matrix of numbers",
        "1004": "impossible intrinsics",
        "1005": "impossible intrinsics",
    }
    frames = write_arkitscenes(walk, walk.folder.parent / "scenes") / "41254925_frames"
    sorted((frames / "lowres_wide_intrinsics").iterdir())[2].write_text("64 48")
    (frames / "lowres_wide" / "cover.png").write_bytes(b"")
    track = frames / "lowres_wide.traj"
    rows = track.read_text().splitlines()
    track.write_text("\n".join([*rows[:11], "damaged"]))
    scan = open_recording(read_arkit(frames))
    check_frames(scan, walk, [0, 1, *range(3, 11)])
    assert sorted(scan.dropped.values()) == ["impossible intrinsics", "no pose", "no time in its name"]


def test_typed_intrinsics_come_first(walk):
    folder = write_scanner(walk, walk.folder.parent / "log")
    for path in folder.glob("frame_*.json"):
        content = json.loads(path.read_text())
        path.write_text(json.dumps({k: v for k, v in content.items() if k != "intrinsics"}))
    assert check_log(folder, walk, intrinsics=walk.camera).lens[5].focal == (50.0, 51.0)
