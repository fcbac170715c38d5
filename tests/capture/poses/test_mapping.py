# SPDX-License-Identifier: Apache-2.0
"""Cameras by pycolmap: those of a drawn room, the same every time; and films of which none can be found."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from raytran.capture.poses.mapping import find_cameras, pairs_to_match
from raytran.errors import DataError

from .box_room import BoxRoom, aligned

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap, which finds the cameras, is not installed")

SIZE = (120, 160)


@pytest.fixture(scope="module")
def room():
    return BoxRoom.make(SIZE)


def drawn(room, poses, folder):
    folder.mkdir(parents=True)
    names = [f"{number:06d}.jpg" for number in range(len(poses))]
    for name, pose in zip(names, poses, strict=True):
        room.draw(pose).save(folder / name, quality=95)
    return names


def test_the_cameras_of_a_room(room, tmp_path):
    poses = room.walk(12, turn=np.pi)
    names = drawn(room, poses, tmp_path / "images")
    told = []
    found = find_cameras(
        tmp_path / "images", names, tmp_path / "work", progress=lambda *what: told.append(what)
    )
    assert found.names == tuple(names)
    assert (found.share, found.num_models, found.image_size) == (1.0, 1, SIZE)
    assert found.focal == pytest.approx(room.focal, rel=0.03)
    aligned_poses, _ = aligned(found.world_from_camera, poses)
    error = np.linalg.norm(aligned_poses[:, :3, 3] - poses[:, :3, 3], axis=1)
    assert error.max() < 0.05
    cosine = (np.einsum("nji,nji->n", aligned_poses[:, :3, :3], poses[:, :3, :3]) - 1) / 2
    assert np.degrees(np.arccos(cosine.min())) < 1.0
    assert {what for what, _, _ in told} == {"finding features", "matching frames", "placing the cameras"}
    # Asked again, all is there; from anew, all is the same to the last bit.
    told.clear()
    again = find_cameras(
        tmp_path / "images", names, tmp_path / "work", progress=lambda *what: told.append(what)
    )
    np.testing.assert_array_equal(again.world_from_camera, found.world_from_camera)
    assert told == []
    anew = find_cameras(tmp_path / "images", names, tmp_path / "anew")
    np.testing.assert_array_equal(anew.world_from_camera, found.world_from_camera)


def test_a_camera_that_only_turns(room, tmp_path):
    poses = room.walk(12)
    poses[:, :3, 3] = poses[0, :3, 3]
    names = drawn(room, poses, tmp_path / "images")
    with pytest.raises(DataError, match=r"only 0 of 12 frames .*only turned on the spot.*walk sideways"):
        find_cameras(tmp_path / "images", names, tmp_path / "work", matching="sequential")


def test_bare_walls(tmp_path):
    (tmp_path / "images").mkdir()
    names = [f"{number}.jpg" for number in range(10)]
    for name in names:
        Image.new("RGB", (160, 120), "white").save(tmp_path / "images" / name)
    with pytest.raises(DataError, match=r"only 0 of 10 frames .*too little texture; film with more light"):
        find_cameras(tmp_path / "images", names, tmp_path / "work")


def test_frames_that_have_nothing_in_common(room, tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    names = [f"{number}.jpg" for number in range(8)]
    for name in names:
        noise = rng.integers(0, 255, (30, 40, 3), dtype=np.uint8)
        Image.fromarray(noise).resize((160, 120)).save(tmp_path / "images" / name)
    with pytest.raises(DataError, match=r"too little in common; film slower, or give frames= larger"):
        find_cameras(tmp_path / "images", names, tmp_path / "work", matching="sequential")


def test_a_damaged_database_is_told(room, tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "database.db").write_bytes(b"no database" * 100)
    names = drawn(room, room.walk(8)[:2], tmp_path / "images")
    with pytest.raises(DataError, match=r"database\.db is damaged .*: delete .*work, then give the command"):
        find_cameras(tmp_path / "images", names, tmp_path / "work")


def test_a_damaged_model_is_told(room, tmp_path):
    names = drawn(room, room.walk(12, turn=np.pi), tmp_path / "images")
    find_cameras(tmp_path / "images", names, tmp_path / "work")
    (tmp_path / "work" / "models" / "sequential" / "0" / "cameras.bin").write_bytes(b"")
    with pytest.raises(DataError, match=r"sequential is damaged .*: delete it, then give the command again"):
        find_cameras(tmp_path / "images", names, tmp_path / "work")


def test_which_pairs_are_compared():
    names = [str(number) for number in range(40)]
    near = pairs_to_match(names, "sequential")
    assert len(near) == len(set(near))
    assert {int(b) - int(a) for a, b in near} == {*range(1, 11), 16, 32}
    every = pairs_to_match(names, "exhaustive")
    assert len(set(every)) == 40 * 39 // 2 == len(every)
    assert set(near) < set(every)
