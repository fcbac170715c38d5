# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import logging

import pytest

from raytran.run import rooms
from raytran.run.rooms import ensure_rooms


@pytest.fixture
def made(monkeypatch):
    """Record the calls of the generator instead of making rooms."""
    calls = []
    monkeypatch.setattr(rooms, "generate_rooms", lambda output, **settings: calls.append(settings))
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
