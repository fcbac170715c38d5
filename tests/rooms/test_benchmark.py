# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace

import numpy as np
import pytest

from raytran.data.dataset import scan2cad_dataset
from raytran.errors import ConfigError, DataError
from raytran.rooms import benchmark
from raytran.rooms.benchmark import generate_rooms_v1, generate_rooms_v1_furniture
from raytran.rooms.generate import generate_rooms
from raytran.rooms.library import ModelPool
from raytran.rooms.materials import texture_library
from raytran.run.entry import compose
from raytran.run.prepare.prepare import prepare

HOW = {"processes": 1, "progress": False}
SPLITS = ("train", "val", "test")


@pytest.fixture(scope="module")
def tiny():
    """Shrink the benchmark's pictures and walks; all else stays what it is."""
    with pytest.MonkeyPatch.context() as patch:
        small = replace(benchmark.SETTINGS, frames=4, image_size=(48, 64), max_objects=8)
        patch.setattr(benchmark, "SETTINGS", small)
        patch.setattr(benchmark, "TEST_FRAMES", 6)
        yield small


@pytest.fixture(scope="module")
def made(tiny, tmp_path_factory):
    root = tmp_path_factory.mktemp("rooms-v1")
    return root, generate_rooms_v1(root, num_train=1, num_val=1, num_test=1, **HOW)


@pytest.fixture(scope="module")
def furnished(tiny, cads, tmp_path_factory):
    root = tmp_path_factory.mktemp("furniture")
    return root, generate_rooms_v1_furniture(root, cads=cads, num_test=2, **HOW)


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def listed(root, split):
    return (root / "scannet" / f"scannetv2_{split}.txt").read_text().split()


def entries(root):
    return json.loads((root / "scan2cad" / "full_annotations.json").read_text())


def chair_ids(numbers):
    """Return the names of all chairs that a pool of these numbers can give."""
    seen, rng = set(), np.random.default_rng(0)
    while len(seen) < len(numbers):
        seen.add(ModelPool(0, numbers=numbers).draw("chair", rng).model_id)
    return seen


def test_its_training_rooms_are_those_of_the_small_preset():
    rooms = compose("prepare", ["preset=small"]).rooms
    same = {name: value for name, value in asdict(benchmark.SETTINGS).items()}
    assert json.loads(json.dumps(same)) == {name: rooms[name] for name in same}


def test_training_rooms_are_the_bytes_of_free_rooms(made, tiny, tmp_path):
    generate_rooms(tmp_path, num_train=1, num_val=0, **asdict(tiny), **HOW)
    for part in ("scannet/scans/scene0000_00", "scan2cad/scans"):
        here = {
            path: text for path, text in content(made[0] / part).items() if "scene0000" in str(part / path)
        }
        assert here == content(tmp_path / part)
    assert entries(made[0])[0] == entries(tmp_path)[0]


def test_three_lists_and_long_test_walks(made):
    root, report = made
    assert (report.train, report.val, report.test) == (
        ("scene0000_00",),
        ("scene8000_00",),
        ("scene9000_00",),
    )
    assert [tuple(listed(root, split)) for split in SPLITS] == [report.train, report.val, report.test]
    assert [entry["id_scan"] for entry in entries(root)] == ["scene0000_00", "scene8000_00", "scene9000_00"]
    for split, frames in (("train", 4), ("val", 4), ("test", 6)):
        dataset = scan2cad_dataset(root, split, cache_dir=root / "cache", targets=(), num_views=frames)
        (scan,) = (root / "scannet" / "scans").glob(listed(root, split)[0])
        valid = [path for path in (scan / "pose").iterdir() if "inf" not in path.read_text()]
        assert (len(dataset), len(valid)) == (1, frames)


def test_no_cad_model_is_in_two_splits(made):
    pools = [chair_ids(range(100 * place, 100 * place + 100)) for place in range(3)]
    assert not pools[0] & pools[1] | pools[1] & pools[2] | pools[0] & pools[2]
    chairs = [
        {model["id_cad"] for model in entry["aligned_models"] if model["catid_cad"] == "03001627"}
        for entry in entries(made[0])
    ]
    assert any(chairs)
    for used, pool in zip(chairs, pools, strict=True):
        assert used <= pool


def test_each_split_has_textures_of_its_own(made):
    draws = [texture_library(draw) for draw in range(3)]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        differs = np.abs(draws[one].texels - draws[other].texels).mean()
        assert differs > 0.05
    again = texture_library(1)
    np.testing.assert_array_equal(again.texels, draws[1].texels)


def test_it_grows_and_never_shrinks(made, tmp_path):
    root = tmp_path / "copy"
    shutil.copytree(made[0], root)
    report = generate_rooms_v1(root, num_train=0, num_val=2, num_test=1, **HOW)
    assert (report.made, report.train, report.val[1:]) == (1, ("scene0000_00",), ("scene8001_00",))
    assert [len(listed(root, split)) for split in SPLITS] == [1, 2, 1]
    assert len(entries(root)) == 4
    before = content(made[0] / "scannet" / "scans")
    assert before.items() <= content(root / "scannet" / "scans").items()


def test_furniture_rooms_use_all_given_models_and_are_for_tests_only(furnished, cads):
    root, report = furnished
    assert (report.train, report.val, report.test) == ((), (), ("scene9500_00", "scene9501_00"))
    facts = {path.parts[-3]: json.loads(path.read_text()) for path in cads.rglob("*.json")}
    used = {model["id_cad"] for entry in entries(root) for model in entry["aligned_models"]}
    assert {facts[name]["split"] for name in used & set(facts)} == {"train", "val"}
    assert (root / "shapenet" / "credits.csv").is_file()
    with pytest.raises(DataError, match=r"there is no .*scannetv2_val.txt"):
        scan2cad_dataset(root, "val", cache_dir=root / "cache")


def test_the_held_out_part_has_no_model_of_training_rooms(tiny, cads, tmp_path):
    """Through the command, so that the setting is seen to arrive."""
    words = f"dataset=rooms-v1-furniture part=held_out cads={cads} output={tmp_path}/x num_test=1 processes=1"
    report = prepare(compose("prepare", words.split()))
    assert report.test == ("scene9500_00",)
    split_of = {
        path.parts[-3]: json.loads(path.read_text())["split"] for path in cads.rglob("model_normalized.json")
    }
    used = {model["id_cad"] for entry in entries(report.root) for model in entry["aligned_models"]}
    assert {split_of[name] for name in used & set(split_of)} == {"val"}
    with pytest.raises(DataError, match=r"other settings \(part\)"):
        generate_rooms_v1_furniture(report.root, cads=cads, num_test=1, **HOW)


def test_other_rooms_are_left_alone(made, furnished, cads, tmp_path):
    with pytest.raises(DataError, match="other settings"):
        generate_rooms_v1(furnished[0], num_train=1, **HOW)
    with pytest.raises(DataError, match="other settings"):
        generate_rooms_v1_furniture(made[0], cads=cads, num_test=1, **HOW)
    with pytest.raises(ConfigError, match="0 to 500 rooms, got num_test=501"):
        generate_rooms_v1_furniture(tmp_path, cads=cads, num_test=501, **HOW)
    assert not any(tmp_path.iterdir())
