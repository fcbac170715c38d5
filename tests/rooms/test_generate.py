# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import shutil

import pytest

from raytran.errors import ConfigError, DataError
from raytran.rooms.generate import generate_rooms

from ..factories import digests

SMALL = {"frames": 6, "image_size": (48, 64), "max_objects": 8, "progress": False, "seed": 3}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("made")
    return root, generate_rooms(root, num_train=2, num_val=1, processes=1, **SMALL)


def test_layout_on_disk(made):
    root, report = made
    assert report.made == 3
    assert (root / "scannet" / "scannetv2_train.txt").read_text() == "scene0000_00\nscene0001_00\n"
    assert (root / "scannet" / "scannetv2_val.txt").read_text() == "scene0002_00\n"
    entries = json.loads((root / "scan2cad" / "full_annotations.json").read_text())
    assert [entry["id_scan"] for entry in entries] == [*report.train, *report.val]
    assert sum(entry["n_aligned_models"] for entry in entries) == report.objects
    appearances = json.loads((root / "scan2cad" / "cad_appearances.json").read_text())
    for entry in entries:
        assert sum(appearances[entry["id_scan"]].values()) == entry["n_aligned_models"]
        for model in entry["aligned_models"]:
            folder = root / "shapenet" / model["catid_cad"] / model["id_cad"] / "models"
            assert (folder / "model_normalized.obj").is_file()


@pytest.mark.slow
def test_same_bytes_from_two_processes(made, tmp_path):
    root, _ = made
    generate_rooms(tmp_path, num_train=2, num_val=1, processes=2, **SMALL)
    assert digests(tmp_path) == digests(root)


def test_a_broken_off_run_is_finished(made, tmp_path):
    root, _ = made
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    scans = copy / "scannet" / "scans"
    shutil.rmtree(scans / "scene0001_00")
    (scans / ".unfinished-scene0001_00.123" / "color").mkdir(parents=True)
    (copy / "scan2cad" / "full_annotations.json").unlink()
    report = generate_rooms(copy, num_train=2, num_val=1, processes=1, **SMALL)
    assert report.made == 1
    assert digests(copy) == digests(root)


def test_other_settings_are_refused(made):
    root, _ = made
    before = digests(root)
    with pytest.raises(DataError, match=r"other settings \(seed\)"):
        generate_rooms(root, num_train=2, num_val=1, processes=1, **(SMALL | {"seed": 4}))
    assert digests(root) == before


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_train": 0},
        {"min_objects": 9},
        {"frames": 1},
        {"room_size": ((1.0, 2.0), (3.0, 4.0))},
    ],
)
def test_contradictions_are_refused(tmp_path, wrong):
    with pytest.raises(ConfigError):
        generate_rooms(tmp_path / "none", **({"num_train": 1, "num_val": 0} | SMALL | wrong))
    assert not (tmp_path / "none").exists()
