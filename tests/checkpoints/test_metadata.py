# SPDX-License-Identifier: Apache-2.0
"""When two runs have the same data, wherever these lie."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from raytran.checkpoints.metadata import DataIdentity
from raytran.run.entry import compose
from raytran.run.train.build import plain


def given(root, annotation=None, name="scan2cad") -> DataIdentity:
    return DataIdentity(name, str(root), annotation)


def known(*settings) -> DataIdentity:
    return DataIdentity.of_config(plain(compose("train", ["preset=tiny", "output_dir=unused", *settings])))


def annotate(root: Path, content: str) -> Path:
    (root / "scan2cad").mkdir(parents=True, exist_ok=True)
    (root / "scan2cad" / "full_annotations.json").write_text(content)
    return root


def test_the_annotation_tells_given_data_apart(tmp_path):
    whole, part = annotate(tmp_path / "whole", "[1, 2, 3]"), annotate(tmp_path / "part", "[1]")
    choose = [known("data=scan2cad", f"data.root={root}") for root in (whole, part)]
    assert choose[0].is_same(choose[0])
    assert not choose[0].is_same(choose[1])
    # A copy, and a folder that was moved, are the same.
    shutil.copytree(whole, tmp_path / "scratch" / "whole")
    copy = known("data=scan2cad", f"data.root={tmp_path / 'scratch' / 'whole'}")
    assert copy.is_same(choose[0])
    shutil.rmtree(whole)
    assert copy.is_same(choose[0])
    # Under another name they are the same too, as long as nobody makes them.
    assert replace(copy, name="mine").is_same(choose[0])


def test_given_data_may_grow(tmp_path, monkeypatch):
    root = annotate(tmp_path / "data", "[1]")
    before = known("data=scan2cad", f"data.root={root}")
    annotate(root, "[1, 2]")
    assert before.annotation != known("data=scan2cad", f"data.root={root}").annotation
    assert known("data=scan2cad", f"data.root={root}").is_same(before)
    # However the folder is written.
    monkeypatch.chdir(tmp_path)
    assert known("data=scan2cad", "data.root=data").is_same(before)
    assert known("data=scan2cad", "data.root=./data/../data").is_same(before)


def test_rooms_of_other_settings_are_others(tmp_path):
    """Before they are made, and so without an annotation, their settings tell."""
    rooms = known(f"data.root={tmp_path / 'a'}")
    assert rooms.annotation is None
    assert rooms.is_same(known(f"data.root={tmp_path / 'b'}", "rooms.processes=1"))
    for other in (["rooms.seed=1"], ["rooms.num_train=8"], ["data.make.cads=cads"], ["data=rooms-v1"]):
        assert not rooms.is_same(known(f"data.root={tmp_path / 'a'}", *other)), other
    assert not rooms.is_same(known("data=scan2cad", f"data.root={tmp_path / 'a'}"))


def test_rooms_that_were_made_anew_in_one_folder_are_others(tmp_path):
    """Unlike data that are given, they cannot have grown."""
    root = annotate(tmp_path / "rooms", "[1]")
    before = known(f"data.root={root}")
    annotate(root, "[2]")
    assert not known(f"data.root={root}").is_same(before)
    assert known(f"data.root={annotate(tmp_path / 'elsewhere', '[1]')}", "rooms.seed=5").is_same(before)


def test_data_of_which_nothing_is_left_are_told_by_name_and_folder():
    assert given("/data/a").is_same(given("/data/b/../a", "ab"))
    assert not given("/data/a").is_same(given("/data/b"))
    assert not given("/data/a").is_same(given("/data/a", name="mine"))
    assert not DataIdentity("scan2cad", None, None).is_same(DataIdentity("scan2cad", None, None))
    assert DataIdentity("scan2cad", None, "ab").is_same(given("/anywhere", "ab"))


@pytest.mark.parametrize(
    ("settings", "name", "text"),
    [
        (["data.root=r"], "rooms", "rooms in r"),
        (["data=rooms-v1", "data.root=r"], "rooms-v1", "rooms-v1 in r"),
        (["data=scan2cad", "data.root=r"], "scan2cad", "scan2cad in r"),
    ],
)
def test_checkpoints_from_before_configs_named_data(settings, name, text):
    config = plain(compose("train", ["preset=tiny", "output_dir=unused", *settings]))
    assert DataIdentity.of_config(config).name == name
    assert DataIdentity.of_checkpoint({"data": DataIdentity.of_config(config).as_plain()}).name == name
    del config["data"]["name"]
    old = DataIdentity.of_checkpoint({"config": config})
    assert (old.name, str(old), old.annotation) == (name, text, None)
    assert old.is_same(known(*settings))
    assert DataIdentity.of_checkpoint({"config": {}}) is DataIdentity.of_checkpoint({}) is None


def test_what_lies_there_today_says_nothing_of_an_old_checkpoint(tmp_path):
    root = annotate(tmp_path / "rooms", "[1]")
    config = plain(compose("train", ["preset=tiny", "output_dir=unused", f"data.root={root}"]))
    assert DataIdentity.of_checkpoint({"config": config}).annotation is None


def test_how_it_is_typed():
    assert given("data/x").typed() == "data=scan2cad data.root=data/x"
    assert str(DataIdentity(None, None)) == "unknown data"
