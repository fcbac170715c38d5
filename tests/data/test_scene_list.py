# SPDX-License-Identifier: Apache-2.0
"""The list of scenes, their objects in a few tensors, and the scans that stay in memory."""

from __future__ import annotations

import pickle

import pytest
import torch

from raytran.data import scene_list
from raytran.data.scan2cad import read_annotations, scene_objects
from raytran.data.scene_list import ObjectTable, RecentScans, choose_scenes
from raytran.errors import DataError
from raytran.structs import ObjectSet


@pytest.fixture
def scenes(write_annotations, cube_entry) -> list[ObjectSet]:
    """Two cubes, none, one."""
    first, second, third = (cube_entry(translation=(x, 0.0, 1.0), id_cad=f"m{x}") for x in (1.0, 2.0, 3.0))
    path = write_annotations({"a": [first, second], "b": [], "c": [third]})
    return [scene_objects(annotation) for annotation in read_annotations(path).values()]


def test_table_gives_the_objects_of_each_scene(scenes) -> None:
    table = pickle.loads(pickle.dumps(ObjectTable(scenes)))
    assert len(table) == 3
    for i, expected in enumerate(scenes):
        assert table[i].model_id == expected.model_id
        for name in ("label", "center", "size", "rotation", "symmetry", "score"):
            assert torch.equal(getattr(table[i], name), getattr(expected, name))
    # A copy: what one sample does to its objects is not seen by the next.
    table[0].center.zero_()
    assert torch.equal(table[0].center, scenes[0].center)


def test_table_of_no_scenes() -> None:
    assert len(ObjectTable([])) == 0


def test_a_scan_is_read_again_only_when_others_took_its_place(write_scan, tmp_path, monkeypatch) -> None:
    for name in "abc":
        write_scan(name, frames=range(4))
    read = []

    def spy(folder):
        read.append(folder.name)
        return real(folder)

    real = scene_list.read_scan
    monkeypatch.setattr(scene_list, "read_scan", spy)
    folder = tmp_path / "scannet" / "scans"
    size = len(pickle.dumps(real(folder / "a")))
    scans = RecentScans(folder, max_bytes=int(2.5 * size))
    for name in ("a", "b", "a", "c", "a", "b"):
        assert scans[name].scene_id == name
        assert torch.equal(scans[name].world_from_camera, real(folder / name).world_from_camera)
        assert scans[name].image_path == real(folder / name).image_path
    # c takes the place of b, which was not used for longest.
    assert read == ["a", "b", "c", "b"]
    assert len(scans) == 2
    assert len(pickle.loads(pickle.dumps(scans))) == 0


def test_a_scan_beyond_the_limit_is_not_kept(write_scan, tmp_path) -> None:
    write_scan("a", frames=range(4))
    scans = RecentScans(tmp_path / "scannet" / "scans", max_bytes=10)
    assert len(scans["a"]) == len(scans["a"]) == 4
    assert len(scans) == 0


def test_scans_that_are_not_there(write_scan, tmp_path) -> None:
    root = write_scan("a").parent
    assert choose_scenes(root, None, None) == ("a",)
    with pytest.raises(DataError, match=r"1 of 2 scans are not in .*, the first is b"):
        choose_scenes(root, ["a", "b"], None)
    with pytest.raises(DataError, match="there is no folder"):
        choose_scenes(tmp_path / "nowhere", None, None)
    with pytest.raises(DataError, match="no scene with objects in the annotation"):
        choose_scenes(root, None, {})
