# SPDX-License-Identifier: Apache-2.0
"""One scene in every form is one scene: the right reader is found, and what nobody knows is said."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from raytran.capture.open import FORMATS, open_scene, parse_intrinsics
from raytran.capture.orientation import WorldSettings
from raytran.errors import ConfigError, DataError

from ..scan_forms import write_form
from .forms import (
    Walk,
    check_frames,
    transforms,
    tum_line,
    words,
    write_colmap,
    write_stray,
    write_transforms,
    write_tum,
    write_video,
)
from .test_arkit import WRITERS

BLIND = WorldSettings(check=False)


@pytest.fixture
def scannet(walk):
    """The walk in the layout of ScanNet's exporter."""
    folder = walk.folder.parent / "exported" / "walk"
    (folder / "pose").mkdir(parents=True)
    (folder / "intrinsic").mkdir()
    (walk.folder / "images").rename(folder / "color")
    (walk.folder / "images").symlink_to(folder / "color")
    for n, pose in enumerate(walk.poses):
        np.savetxt(folder / "pose" / f"{n}.txt", pose)
    fx, fy, cx, cy = walk.camera
    matrix = np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", matrix)
    return folder


@pytest.mark.usefixtures("without_pycolmap")
def test_a_walk_is_the_same_in_every_form_and_needs_no_extra(walk, scannet, tmp_path):
    places = {"scannet": scannet, "nerfstudio": write_transforms(walk), "tum": tmp_path / "tum"}
    write_tum(walk, places["tum"], np.arange(12) / 10)
    for name, write in WRITERS.items():
        places[name] = write(walk, tmp_path / name)
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    places["colmap"] = walk.folder / "sparse" / "0"
    if importlib.util.find_spec("av"):
        places["video"] = tmp_path / "walk.mp4"
        write_video(walk, places["video"])
        lines = [tum_line(n / 10, pose) for n, pose in enumerate(walk.poses)]
        (tmp_path / "walk.txt").write_text("\n".join(lines))
        (tmp_path / "intrinsics.txt").write_text(words(walk.camera))
    scans = {name: open_scene(path, settings=BLIND) for name, path in places.items()}
    expected = scans["scannet"]
    for name, scan in scans.items():
        assert len(scan) == 12
        np.testing.assert_allclose(
            scan.world_from_camera, expected.world_from_camera, atol=1e-6, err_msg=name
        )
        np.testing.assert_allclose(scan.intrinsics, expected.intrinsics, atol=1e-9)
        close = scan.read_color(9, (24, 32)).astype(int) - expected.read_color(9, (24, 32))
        assert np.abs(close).max() <= (4 if name == "video" else 0)
        scan.close()


def test_paths_may_be_relative(walk, monkeypatch):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    write_transforms(walk, frames=transforms(walk)["frames"][1:])
    monkeypatch.chdir(walk.folder)
    assert len(open_scene(Path("."), format="colmap", settings=BLIND)) == 12
    scan = open_scene(Path("transforms.json"), settings=BLIND)
    assert (scan.scene_id, scan.dropped) == ("walk", {"11": "no pose"})


def test_the_format_may_be_named(walk, caplog):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    write_transforms(walk)
    caplog.set_level("INFO")
    assert open_scene(walk.folder, settings=BLIND).path.name == "transforms.json"
    assert "is there as nerfstudio, colmap: reading nerfstudio; format= chooses" in caplog.text
    assert open_scene(walk.folder, format="colmap", settings=BLIND).path.name == "images.bin"


def test_a_scan_of_scannet_comes_first(walk, scannet):
    poses = Walk(scannet, walk.names, walk.poses, walk.image_size, walk.camera)
    write_transforms(poses, frames=[])
    assert open_scene(scannet, settings=BLIND).path == scannet


@pytest.mark.parametrize("form", ["cpp", "odam", "mmdetection3d", "frames_25k"])
def test_scannets_other_forms_are_recognised(walk, scannet, form, tmp_path):
    write_form(form, scannet, tmp_path / form / "walk")
    assert len(open_scene(tmp_path / form / "walk", settings=BLIND)) == 12


def test_what_is_not_there_or_unknown(walk, tmp_path):
    with pytest.raises(ConfigError, match=f"unknown format=kitti: choose one of {', '.join(FORMATS)}"):
        open_scene(walk.folder, format="kitti")
    with pytest.raises(DataError, match=r"there is no scene .*nowhere: check the path"):
        open_scene(tmp_path / "nowhere")
    for name in ("9" * 300, "9" * 300 + ".zip"):
        with pytest.raises(DataError, match="there is no scene"):
            open_scene(tmp_path / name)
    with pytest.raises(DataError, match="has images without poses: raytran poses finds them"):
        open_scene(walk.folder)
    (tmp_path / "0.JPG").touch()
    with pytest.raises(DataError, match=r"0\.JPG is one image: give the folder with all frames"):
        open_scene(tmp_path / "0.JPG")
    (tmp_path / "notes.doc").write_text("")
    with pytest.raises(DataError, match=r"notes\.doc is in none of the formats scannet, "):
        open_scene(tmp_path / "notes.doc")


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ([], "is empty: give the folder of a scene"),
        (
            ["notes.md"],
            r"holds 1 files \.md, and no scene: read are ScanNet, 7-Scenes, transforms\.json, COLMAP",
        ),
        (["images/0.jpg"], "has images without poses: raytran poses finds them"),
        (["0.WEBP", "1.webp"], "has images without poses"),
        (["trajectory.txt"], r"has poses in trajectory\.txt but no images: put them in its folder rgb"),
        (["metadata.json"], "has Record3D's metadata but no folder rgb/ or rgbd/"),
        (["odometry.csv", "depth/0.png"], r"has Stray Scanner's odometry\.csv but no rgb\.mp4"),
        (["keyframes/depth/1.png"], "has Polycam's keyframes without cameras/ and images/"),
        (["images/0.jpg", "database.db"], "has parts of a COLMAP project but no model"),
        (["images/0.jpg", "sparse/0/cameras.txt"], "has parts of a COLMAP project but no model"),
        (
            ["color/0.jpg", "intrinsic/a.txt"],
            r"has ScanNet's color/ and intrinsic/ but no pose/: wanted is a 4x4 matrix",
        ),
        (["a.mp4", "b.mp4"], "holds 2 videos: give the path of one of them"),
        (["._a.mp4", ".DS_Store"], "is empty"),
    ],
)
def test_what_a_folder_lacks_is_said(tmp_path, files, message):
    folder = tmp_path / "scene"
    folder.mkdir()
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    with pytest.raises(DataError, match=message) as caught:
        open_scene(folder)
    assert len(str(caught.value).replace(str(folder), "")) <= 260
    assert "intrinsic_color" not in str(caught.value)


def test_scenes_below_a_folder_are_named(walk, scannet, tmp_path):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    with pytest.raises(DataError, match=r"is no scene but holds some: give one of walk, exported/walk$"):
        open_scene(tmp_path)
    for n in range(4):
        (tmp_path / "exported" / str(n)).symlink_to(scannet)
    with pytest.raises(DataError, match=r"holds some: give one of 0, 1, 2 and 2 more$"):
        open_scene(tmp_path / "exported")


@pytest.mark.parametrize("form", ["scannet", "nerfstudio", "tum", "polycam", "scanner", "colmap"])
def test_typed_intrinsics_are_those_of_the_stored_images_in_every_format(walk, scannet, form, tmp_path):
    places = {"scannet": scannet, "nerfstudio": walk.folder, "tum": tmp_path / "tum", "colmap": walk.folder}
    write_tum(walk, tmp_path / "tum", np.arange(12) / 10)
    if form == "nerfstudio":
        write_transforms(walk)
    elif form == "colmap":
        write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    elif form in WRITERS:
        places[form] = WRITERS[form](walk, tmp_path / form)
    scan = open_scene(places[form], settings=BLIND, intrinsics=(40, 41, 32, 24))
    values = scan.intrinsics.reshape(-1, 3, 3)[0].numpy()
    assert values[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == [40, 41, 32, 24]
    with pytest.raises(DataError, match=r"intrinsics=.* has its principal point at"):
        open_scene(places[form], settings=BLIND, intrinsics=(40, 41, 320, 240))


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        (None, None),
        ("500,510,320,240", (500, 510, 320, 240)),
        ("[500, 510, 320.5, 240]", (500, 510, 320.5, 240)),
        ([500, 510, 320, 240], (500, 510, 320, 240)),
    ],
)
def test_intrinsics_as_typed(typed, expected):
    assert parse_intrinsics(typed) == expected


@pytest.mark.parametrize(
    "typed", ["500,510,320", "a,b,c,d", "500,nan,1,1", "-5,5,1,1", 500, [1, 2], {"fx": 1}, "9" * 999]
)
def test_what_are_no_intrinsics(typed):
    with pytest.raises(ConfigError, match="are not fx,fy,cx,cy in pixels of the stored images") as caught:
        parse_intrinsics(typed)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("number_of_files", [1, 0])
def test_7_scenes_promises_no_up(walk, scannet, tmp_path, number_of_files):
    """A world whose +y is down, as of the first camera; intrinsics beside the sequence or above it."""
    down = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    folder = tmp_path / "chess" / "seq-01"
    folder.mkdir(parents=True)
    for n, name in enumerate(walk.names):
        np.savetxt(folder / f"frame-{n:06d}.pose.txt", down @ walk.poses[n])
        (folder / f"frame-{n:06d}.color.png").write_bytes((walk.folder / "images" / name).read_bytes())
        (folder / f"frame-{n:06d}.depth.png").write_bytes(b"")
    with pytest.raises(DataError, match="or give intrinsics=fx,fy,cx,cy"):
        open_scene(folder, settings=BLIND)
    check_frames(open_scene(folder, settings=BLIND, intrinsics=walk.camera), walk)
    place = folder if number_of_files else folder.parent
    (place / "camera-intrinsics.txt").write_text("50 0 31\n0 51 25\n0 0 1\n")
    check_frames(open_scene(folder, settings=BLIND), walk)


def test_the_demo_of_tsdf_fusion(walk, tmp_path):
    folder = tmp_path / "demo" / "data"
    folder.mkdir(parents=True)
    for n, name in enumerate(walk.names):
        np.savetxt(folder / f"frame-{n:06d}.pose.txt", walk.poses[n])
        (folder / f"frame-{n:06d}.color.jpg").write_bytes((walk.folder / "images" / name).read_bytes())
    (folder / "camera-intrinsics.txt").write_text("50 0 31\n0 51 25\n0 0 1\n")
    for path in (folder, folder.parent):
        check_frames(open_scene(path, settings=BLIND), walk)


def test_stray_scanner_is_recognised(walk, tmp_path):
    check_frames(open_scene(write_stray(walk, tmp_path / "stray"), settings=BLIND), walk)
