# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import logging
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from raytran.data.prepare import Prepared
from raytran.data.prepare.boxed_scan import FoundSources
from raytran.errors import ConfigError, DataError
from raytran.run.entry import compose
from raytran.run.prepare import prepare as module
from raytran.run.prepare.prepare import prepare


@pytest.fixture
def called(monkeypatch):
    """Record what the makers of data sets are called with instead of making any."""
    calls = {}

    def record(name):
        def call(*arguments, **options):
            calls[name] = (arguments, options)
            return name

        monkeypatch.setattr(module, name, call)

    for name in ("generate_rooms", "import_furniture", "check"):
        record(name)
    return calls


def config(*overrides):
    return compose("prepare", ["preset=tiny", *overrides])


def test_rooms_get_the_presets_sizes_and_the_models_given(called):
    assert prepare(config("dataset=rooms", "output=x", "num_val=3", "cads=models")) == "generate_rooms"
    (output,), options = called["generate_rooms"]
    assert output == Path("x")
    assert (options["num_train"], options["num_val"], options["cads"]) == (4, 3, Path("models"))
    assert options["image_size"] == [120, 160]


def test_furniture_and_checks_are_passed_on(called):
    prepare(config("dataset=cads", "source=lib", "output=x", "processes=1"))
    assert called["import_furniture"] == ((Path("lib"), Path("x")), {"processes": 1})
    cfg = config("check=some/scan")
    assert prepare(cfg) == "check"
    assert called["check"] == ((cfg,), {})


def test_commands_of_the_documentation_compose(project_root):
    text = (project_root / "docs" / "data.md").read_text(encoding="utf-8")
    commands = re.findall(r"raytran prepare ([^`\n]+)", text)
    assert len(commands) >= 6
    for words in commands:
        compose("prepare", words.split())
    options = re.findall(r"^\| `([^`]+=[^`]+)` \|", text, flags=re.MULTILINE)
    assert len(options) == 5
    compose("prepare", options)


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ((), "output= is missing"),
        (("output=x", "num_test=3"), "leave out num_test=: dataset=rooms has no test rooms"),
        (("dataset=rooms-v1", "output=x", "seed=1", "frames=9"), "leave out seed=, frames="),
        (("dataset=rooms-v1", "output=x", "image_size=[120,160]"), "leave out image_size="),
        (("dataset=rooms-v1", "output=x", "cads=y"), "dataset=rooms-v1-furniture"),
        (("dataset=rooms-v1", "output=x", "num_val=1001"), "0 to 1000 rooms, got num_val=1001"),
        (
            ("dataset=rooms-v1", "output=x", "num_train=0", "num_val=0", "num_test=0"),
            "no rooms are asked for",
        ),
        (("dataset=rooms-v1-furniture", "output=x"), "cads= is missing"),
        (("dataset=rooms-v1-furniture", "output=x", "cads=y", "num_val=1"), "has test rooms only"),
        (("dataset=rooms-v1-furniture", "output=x", "cads=y", "min_objects=1"), "leave out min_objects="),
        (("dataset=rooms-v1-furniture", "output=x", "cads=y", "part=train"), "one of all, held_out"),
        (("dataset=rooms", "output=x", "part=held_out"), "leave out part="),
        (("dataset=rooms-v1", "output=x", "part=all"), "leave out part="),
        (("dataset=rooms-v2", "output=x", "part=all"), "leave out part="),
        (
            ("dataset=scannet", "output=x"),
            "choose one of rooms, rooms-v1, rooms-v1-furniture, rooms-v2, scan2cad, boxes, arkitscenes, cads",
        ),
        (("dataset=scan2cad", "output=x"), "scannet= is missing"),
        (("dataset=cads", "output=x"), "source= is missing"),
        (("dataset=boxes", "output=x"), "captures= is missing"),
        (("dataset=arkitscenes", "output=x"), "arkitscenes= is missing"),
        (
            ("dataset=boxes", "output=x", "captures=y", "categories={couch: settee}"),
            "couch=settee names no class",
        ),
        (("dataset=scan2cad", "scannet=a", "scan2cad=b", "output=x"), "give shapenet="),
        (("dataset=scan2cad", "scannet=a", "max_frames=1", "output=x"), "max_frames ≥ 2"),
    ],
)
def test_what_is_missing_is_said(typed, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=said):
        prepare(config(*typed))
    assert not any(tmp_path.iterdir())


def test_scans_without_annotation_from_the_command_line(tmp_path, caplog):
    write_scan(tmp_path / "scans" / "scene0000_00")
    overrides = [f"scannet={tmp_path}", f"output={tmp_path / 'out'}", "max_frames=2", "masks=false"]
    with caplog.at_level(logging.INFO):
        prepared = prepare(config("dataset=scan2cad", "processes=1", *overrides))
    assert prepared.report["frames"]["written"] == 2
    marker = json.loads((tmp_path / "out" / "prepare.json").read_text())
    assert (marker["image_size"], marker["max_frames"], marker["masks"]) == ([120, 160], 2, False)
    said = [record.getMessage() for record in caplog.records]
    assert "found: scans 1 (exporter 1); no CAD models" in said[0]
    assert "scans 1, frames about 2; expect" in said[1]
    assert said[-1] == f"raytran train data=scan2cad data.root={tmp_path / 'out'}"


def test_captures_with_classes_of_ones_own_from_the_command_line(tmp_path, caplog):
    write_scan(tmp_path / "captures" / "hall")
    entry = {"category": "chair", "center": [0, 0, 2], "size": [1, 1, 1], "mesh": None}
    lists = tmp_path / "lists" / "hall"
    lists.mkdir(parents=True)
    (lists / "scene.json").write_text(json.dumps([entry, entry | {"category": "Old Drill"}]))
    typed = [f"captures={tmp_path / 'captures'}", f"boxes={tmp_path / 'lists'}", f"output={tmp_path / 'out'}"]
    typed += ["classes.names=[drill,chair]", "categories={old drill: drill}", "processes=1"]
    with caplog.at_level(logging.INFO):
        prepared = prepare(config("dataset=boxes", *typed))
    assert prepared.report["objects"]["train"] == {"chair": 1, "drill": 1}
    said = [record.getMessage() for record in caplog.records]
    assert any("to do: scans 1, frames about 4; expect" in text for text in said)
    assert said[-1] == (
        f"raytran train data=boxes data.root={tmp_path / 'out'} 'classes.names=[drill,chair]'"
    )
    unknown = [*typed[:4], "processes=1"]
    with pytest.raises(
        DataError, match=r"is of category 'Old Drill', which is no class: choose one of drill"
    ):
        prepare(config("dataset=boxes", *unknown[:2], f"output={tmp_path / 'other'}", *unknown[3:]))


def test_arkitscenes_and_its_classes_from_the_command_line(monkeypatch, caplog, tmp_path):
    calls = []

    def find(root, categories, **options):
        calls.append((root, categories, options))
        return FoundSources((), (), ("1",))

    monkeypatch.setattr(module, "find_arkitscenes", find)
    report = Prepared(tmp_path, {}, "report")
    monkeypatch.setattr(module, "prepare_boxes", lambda *args, **options: calls.append(options) or report)
    with caplog.at_level(logging.INFO):
        prepare(
            config("dataset=arkitscenes", "classes=arkitscenes", "arkitscenes=a", "output=x", "splits=[val]")
        )
    (root, categories, options), passed_on = calls
    assert (root, options) == (Path("a"), {"scenes": None, "splits": ["val"]})
    assert categories.unknown_left_out
    assert len(categories.classes) == 17
    assert passed_on["left_out"] == {"scans_without_boxes": [], "boxes_without_scan": ["1"]}
    assert caplog.messages[-1] == "raytran train data=arkitscenes data.root=x classes=arkitscenes"


def write_scan(folder):
    for part in ("color", "pose", "intrinsic"):
        (folder / part).mkdir(parents=True)
    for n in range(4):
        Image.new("RGB", (48, 32), (n, n, n)).save(folder / "color" / f"{n}.jpg")
        np.savetxt(folder / "pose" / f"{n}.txt", np.eye(4))
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", [[40, 0, 24], [0, 40, 16], [0, 0, 1]])
