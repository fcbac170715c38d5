# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from raytran.data.shapenet.models import read_mesh
from raytran.rooms.write import annotation_path, write_scene


def matrix(trs):
    pose = np.eye(4)
    w, x, y, z = trs["rotation"]
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix() * np.array(trs["scale"])
    pose[:3, 3] = trs["translation"]
    return pose


def numbers(path):
    return np.array([float(word) for word in path.read_text().split()]).reshape(4, 4)


@pytest.fixture(scope="module")
def written(scenes, tmp_path_factory):
    root = tmp_path_factory.mktemp("rooms")
    write_scene(scenes[0], scan_id="scene0000_00", root=root, rng=np.random.default_rng(0))
    return root, scenes[0]


def test_frames_have_unpadded_numbers_and_two_or_three_lost_poses(written):
    root, scene = written
    folder = root / "scannet" / "scans" / "scene0000_00"
    names = sorted(int(path.stem) for path in (folder / "color").glob("*.jpg"))
    assert names == sorted(int(path.stem) for path in (folder / "pose").glob("*.txt"))
    assert names == [10 * i for i in range(len(names))]
    lost = [name for name in names if "-inf" in (folder / "pose" / f"{name}.txt").read_text()]
    assert len(lost) in (2, 3)
    assert len(names) - len(lost) == len(scene.cameras)
    with Image.open(folder / "color" / "10.jpg") as picture:
        assert picture.size == (80, 60)


def test_poses_are_the_cameras_in_the_scan_frame(written):
    root, scene = written
    folder = root / "scannet" / "scans" / "scene0000_00"
    np.testing.assert_allclose(
        numbers(folder / "pose" / "0.txt"),
        scene.scan_from_room @ scene.cameras[0].room_from_camera,
        atol=1e-6,
    )
    intrinsics = numbers(folder / "intrinsic" / "intrinsic_color.txt")
    np.testing.assert_allclose(intrinsics[:3, :3], scene.cameras[0].intrinsics, atol=1e-6)


def test_axis_alignment_sets_the_room_straight(written):
    root, scene = written
    text = (root / "scannet" / "scans" / "scene0000_00" / "scene0000_00.txt").read_text()
    facts = dict(line.split(" = ") for line in text.splitlines())
    alignment = np.array([float(word) for word in facts["axisAlignment"].split()]).reshape(4, 4)
    assert np.degrees(np.arccos(alignment[0, 0])) > 2.9
    aligned = alignment @ scene.scan_from_room
    np.testing.assert_allclose(aligned[:3, :3], np.eye(3), atol=1e-5)
    np.testing.assert_allclose(aligned[:2, 3], -np.array(scene.room.size[:2]) / 2, atol=1e-4)


def test_annotation_places_the_cad_where_it_was_drawn(written):
    """inv(M_scan) · T · R · S of the files puts the mesh on the triangles that were rendered."""
    root, scene = written
    entry = json.loads(annotation_path(root, "scene0000_00").read_text())
    assert entry["n_aligned_models"] == len(scene.objects) == len(entry["aligned_models"])
    scan = matrix(entry["trs"])
    assert np.abs(scan - np.eye(4)).max() > 0.5
    for model, placed in zip(entry["aligned_models"], scene.objects, strict=True):
        pose = np.linalg.inv(scan) @ matrix(model["trs"])
        mesh = read_mesh(root / "shapenet", model["catid_cad"], model["id_cad"])
        in_scan = mesh.triangles.mean(axis=1) @ pose[:3, :3].T + pose[:3, 3]
        room = placed.triangles().mean(axis=1)
        drawn = room @ scene.scan_from_room[:3, :3].T + scene.scan_from_room[:3, 3]
        # The file lists the faces by material, so in another order.
        assert len(drawn) == len(in_scan)
        assert cKDTree(drawn).query(in_scan)[0].max() < 2e-5
        assert cKDTree(in_scan).query(drawn)[0].max() < 2e-5
        used = mesh.triangles.reshape(-1, 3)
        np.testing.assert_allclose(model["bbox"], np.ptp(used, axis=0) / 2, atol=2e-6)
        np.testing.assert_allclose(model["center"], (used.min(axis=0) + used.max(axis=0)) / 2, atol=2e-6)


def test_nothing_temporary_is_left(written):
    root, _ = written
    assert not [path for path in root.rglob("*") if path.name.startswith(".")]


def test_a_failure_leaves_no_scan(scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(type(scenes[0].renderer), "render", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_scene(scenes[0], scan_id="scene0000_00", root=tmp_path, rng=np.random.default_rng(0))
    assert list((tmp_path / "scannet" / "scans").iterdir()) == []
