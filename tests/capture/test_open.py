# SPDX-License-Identifier: Apache-2.0
"""One scene in every form is one scene: the right reader is found, and what nobody knows is said."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from raytran.capture.open import FORMATS, open_scene
from raytran.capture.orientation import WorldSettings
from raytran.errors import ConfigError, DataError

from ..scan_forms import write_form
from .forms import Walk, transforms, tum_line, words, write_colmap, write_transforms, write_tum, write_video
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
    with pytest.raises(DataError, match="has images without poses: let COLMAP or a phone's ARKit find them"):
        open_scene(walk.folder)
    (tmp_path / "notes.doc").write_text("")
    with pytest.raises(DataError, match=r"notes\.doc is in none of the formats scannet, "):
        open_scene(tmp_path / "notes.doc")
