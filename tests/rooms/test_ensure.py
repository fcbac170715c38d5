# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import logging

import pytest

from raytran.errors import ConfigError
from raytran.rooms import ensure as rooms
from raytran.rooms.ensure import ensure_rooms, ensure_rooms_v1, ensure_rooms_v2
from raytran.run.entry import compose
from raytran.run.train.build import build_data


@pytest.fixture
def made(monkeypatch):
    """Record the calls of the generator instead of making rooms."""
    calls = []
    for name in ("generate_rooms", "generate_rooms_v1", "generate_rooms_v2"):
        monkeypatch.setattr(rooms, name, lambda output, **settings: calls.append(settings))
    return calls


def write_set(folder, scans, present):
    scannet = folder / "scannet"
    (scannet / "scans").mkdir(parents=True)
    (folder / "rooms.json").write_text(json.dumps({"num_train": 1, "num_val": 1, "seed": 0}))
    (scannet / "scannetv2_train.txt").write_text(f"{scans[0]}\n")
    (scannet / "scannetv2_val.txt").write_text(f"{scans[1]}\n")
    for scan in present:
        (scannet / "scans" / scan).mkdir()


def test_rooms_are_made_on_first_use(tmp_path, made):
    ensure_rooms(tmp_path / "rooms", num_train=2, num_val=1)
    assert made == [{"num_train": 2, "num_val": 1}]


def test_elsewhere_rooms_are_asked_for(tmp_path, made):
    (tmp_path / "rooms-mine").mkdir()
    (tmp_path / "rooms-mine" / "rooms.json").write_text("{}")
    asked = {"num_train": 2, "num_val": 1, "usual": tmp_path / "usual"}
    with pytest.raises(ConfigError) as refused:
        ensure_rooms(tmp_path / "room-mine", allowed="auto", **asked)
    assert str(refused.value) == (
        f"there are no rooms in data.root={tmp_path / 'room-mine'}: is {tmp_path / 'rooms-mine'} meant? "
        "rooms.make=true makes 3 of them there"
    )
    with pytest.raises(ConfigError, match=r"rooms.make=true makes 3"):
        ensure_rooms(tmp_path / "usual", allowed=False, **asked)
    with pytest.raises(ConfigError, match=r"unknown rooms\.make=perhaps"):
        ensure_rooms(tmp_path / "usual", allowed="perhaps", **asked)
    assert made == []
    for folder, allowed in (("rooms-mine", "auto"), ("usual", "auto"), ("elsewhere", True)):
        ensure_rooms(tmp_path / folder, allowed=allowed, **asked)
    assert made == [{"num_train": 2, "num_val": 1}] * 3


def test_training_asks_for_rooms_in_another_folder_than_its_own(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    build_data(compose("train", ["preset=tiny", "output_dir=x"])).prepare_data()
    assert len(made) == 1
    words = ["preset=tiny", "output_dir=x", "data.root=nope"]
    with pytest.raises(ConfigError, match=r"there are no rooms in data\.root=nope"):
        build_data(compose("train", words)).prepare_data()
    build_data(compose("train", [*words, "rooms.make=true"])).prepare_data()
    assert len(made) == 2


def test_a_whole_set_is_used_as_it_is(tmp_path, made, caplog):
    write_set(tmp_path, ("a", "b"), present=("a", "b"))
    with caplog.at_level(logging.WARNING):
        ensure_rooms(tmp_path, num_train=1, num_val=1, seed=0)
        assert not caplog.records
        ensure_rooms(tmp_path, num_train=5, num_val=1, seed=0)
    assert made == []
    assert "made with num_train=1" in caplog.text


def test_an_interrupted_set_is_completed(tmp_path, made):
    write_set(tmp_path, ("a", "b"), present=("a",))
    ensure_rooms(tmp_path, num_train=1, num_val=1)
    assert len(made) == 1


def test_a_whole_benchmark_is_used_and_a_smaller_one_is_completed(tmp_path, made):
    write_set(tmp_path, ("a", "b"), present=("a", "b", "c"))
    asked = {"num_train": 1, "num_val": 1, "num_test": 1}
    ensure_rooms_v1(tmp_path, **asked)
    assert len(made) == 1  # the list of test rooms is missing
    (tmp_path / "scannet" / "scannetv2_test.txt").write_text("c\n")
    for count in (0, 1):
        ensure_rooms_v1(tmp_path, **(asked | {"num_test": count}))
    assert len(made) == 1
    ensure_rooms_v1(tmp_path, **(asked | {"num_test": 2}))
    assert made[1:] == [asked | {"num_test": 2, "processes": 0, "progress": True}]


def test_whole_rooms_v2_are_used_and_fewer_are_completed(tmp_path, made):
    write_set(tmp_path, ("a", "b"), present=("a", "b"))
    ensure_rooms_v2(tmp_path, num_train=1, num_val=1)
    assert not made
    ensure_rooms_v2(tmp_path, num_train=2, num_val=1)
    assert made == [{"num_train": 2, "num_val": 1, "cads": None, "processes": 0, "progress": True}]


def test_rooms_v2_as_training_data(made, tmp_path):
    typed = ["data=rooms-v2", f"data.root={tmp_path}", "data.make.num_train=7", "output_dir=x"]
    with pytest.raises(ConfigError, match=r"rooms\.make=true makes 57 of them there"):
        build_data(compose("train", typed)).prepare_data()
    build_data(compose("train", [*typed, "rooms.make=true", "data.make.cads=furniture"])).prepare_data()
    assert made == [{"num_train": 7, "num_val": 50, "cads": "furniture", "processes": 0, "progress": True}]


def test_the_benchmark_as_training_data(made, tmp_path):
    cfg = compose(
        "train",
        [
            "data=rooms-v1",
            f"data.root={tmp_path}",
            "data.make.num_train=7",
            "rooms.make=true",
            "output_dir=x",
        ],
    )
    data = build_data(cfg)
    data.prepare_data()
    assert made == [{"num_train": 7, "num_val": 100, "num_test": 100, "processes": 0, "progress": True}]
