# SPDX-License-Identifier: Apache-2.0
"""The yardstick for networks: what it counts itself, how it asks the commands, and which rows it keeps."""

from __future__ import annotations

import json
import sys

import pytest
import real
import real_rows
import torch

from raytran.checkpoints.file import checkpoint_path, file_digest
from raytran.classes import PAPER_CLASSES
from raytran.export import write_scene_json
from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import ObjectSet, ScenePrediction

CHAIR, TABLE, OTHER = (PAPER_CLASSES.index(name) for name in ("chair", "table", "other"))


def boxes(label, center, score=None):
    count = len(label)
    return ObjectSet(
        label=torch.tensor(label),
        center=torch.tensor(center, dtype=torch.float32).reshape(count, 3),
        size=torch.ones(count, 3),
        rotation=rotation_from_yaw(torch.zeros(count)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count) if score is None else torch.tensor(score),
    )


def test_boxes_that_share_room_with_a_true_one_of_any_class():
    predicted = boxes([CHAIR, CHAIR, TABLE], [[0.9, 0, 0], [3, 0, 0], [1.1, 0, 0]])
    assert real.overlaps_any(predicted, boxes([TABLE], [[0, 0, 0]])).tolist() == [True, False, False]
    assert not real.overlaps_any(predicted, ObjectSet.empty()).any()


def test_a_piece_is_found_by_one_near_object_of_its_class():
    pieces = torch.tensor([TABLE, TABLE, CHAIR]), torch.tensor([[0.0, 0, 0], [0.3, 0, 0], [5, 0, 0]]).double()
    assert real.pieces_found(boxes([TABLE], [[0.1, 0, 0]]), *pieces) == 1
    assert real.pieces_found(boxes([TABLE, TABLE], [[0.1, 0, 0], [0.2, 0, 0]]), *pieces) == 2
    assert real.pieces_found(boxes([TABLE, CHAIR], [[5, 0, 0], [5.5, 0, 0]]), *pieces) == 0
    assert real.pieces_found(ObjectSet.empty(), *pieces) == 0


def test_given_pieces_are_told_from_generated_ones(tmp_path, write_annotations, cube_entry):
    write_annotations({"a": [cube_entry(), cube_entry(id_cad="other")], "b": [cube_entry()]})
    (tmp_path / "cads.json").write_text(json.dumps({"models": [{"model_id": "cube"}]}))
    found = [("a", "0", "True"), ("a", "1", "True"), ("b", "0", "False")]
    rows = [dict(zip(("scene_id", "object", "matched"), row, strict=True)) for row in found]
    assert real.accuracy_of_given(tmp_path, rows) == 0.5
    assert real.accuracy_of_given(tmp_path, rows[1:2]) is None


@pytest.fixture
def folders(tmp_path, write_annotations, cube_entry):
    """The real cases, with nothing to see: the commands are pretended."""
    (tmp_path / "lounge" / "scans" / "walk").mkdir(parents=True)
    pieces = [
        {"scan2cad_class": "chair", "center": [0, 0, 0]},
        {"scan2cad_class": None, "center": [2, 0, 0]},
    ]
    (tmp_path / "lounge" / "boxes.json").write_text(json.dumps({"objects": pieces}))
    write_annotations({"scene0470_00": [cube_entry()]}, root=tmp_path / "scan")
    write_annotations({"scene9500_00": [cube_entry()]}, root=tmp_path / "furniture")
    (tmp_path / "furniture" / "cads.json").write_text(json.dumps({"models": [{"model_id": "cube"}]}))
    return {name: tmp_path / name for name in ("rooms", "furniture", "scan", "lounge")}


@pytest.fixture
def commands(monkeypatch):
    """Pretend ``evaluate`` and ``predict``; return what they are asked."""
    asked = []
    strict = {
        "global_average": 0.5,
        "per_threshold": {"0.25": {"f1": 0.6, "n_predicted": 7, "n_true": 9}},
        "calibration": {"counted": {"expected_error": 0.2}, "every_score": {"expected_error": 0.1}},
    }
    shape = {"iou": 0.4, "chamfer_distance": 0.05}
    shape["per_class"] = {"chair": {"iou": 0.2, "chamfer_distance": 0.04}}

    def run(*words):
        asked.append(words)
        settings = dict(word.split("=", 1) for word in words[1:])
        output = real.Path(settings["output"])
        output.mkdir(parents=True)
        if words[0] == "evaluate":
            (output / "metrics.json").write_text(json.dumps({"strict": strict, "shape": shape}))
            (output / "per_object.csv").write_text("scene_id,object,matched\nscene9500_00,0,True\n")
            return
        found = boxes([CHAIR, OTHER, CHAIR], [[0.2, 0, 0], [2.3, 0, 0.2], [8, 0, 0]])
        prediction = ScenePrediction("walk", found, torch.zeros(3))
        write_scene_json(output / "scene.json", prediction, [None] * 3)

    monkeypatch.setattr(real, "run", run)
    return asked


def measure(monkeypatch, table, folders, *words):
    options = [word for case, folder in folders.items() for word in (f"--{case}", str(folder))]
    monkeypatch.setattr(sys, "argv", ["real.py", "default", *options, "--table", str(table), *words])
    real.main()
    return real_rows.read_kept(table)


def test_a_row_has_all_cases_and_is_replaced(commands, folders, tmp_path, monkeypatch, capsys):
    folders["rooms"].mkdir()
    table = tmp_path / "real.csv"
    (row,) = measure(monkeypatch, table, folders, "--scenes", "3")
    assert row["sha256"] == file_digest(checkpoint_path("default"))[:12]
    assert (row["scenes"], row["num_views"], row["score_threshold"]) == ("3", "24", "own")
    assert (row["rooms_accuracy"], row["rooms_shape_iou"], row["rooms_chair_iou"]) == ("0.5", "0.4", "0.2")
    assert (row["furniture_calibration"], row["furniture_calibration_every"]) == ("0.2", "0.1")
    assert row["furniture_given_accuracy"] == "1.0"
    assert (row["scan_f1"], row["scan_in_nothing"]) == ("0.6", "2")
    assert (row["lounge_right"], row["lounge_true"], row["lounge_predicted"]) == ("2", "2", "3")
    of_rooms = next(words for words in commands if f"data.root={folders['rooms']}" in words)
    assert {"split=test", "num_views=24", "max_scenes=3"} <= set(of_rooms)
    assert not any(word.startswith("score_threshold") for words in commands for word in words)
    page = table.with_suffix(".md").read_text()
    assert "| default | 50.0 % | 0.600 | 7 | 9 | 0.400 | 5.0 cm | 0.200 | 4.0 cm |" in page

    again = measure(monkeypatch, table, folders, "--scenes", "3", "--names", "shipped")
    assert [one["name"] for one in again] == ["shipped"]
    assert len(measure(monkeypatch, table, folders, "--num-views", "5", "--score-threshold", "0.3")) == 2
    assert "max_scenes=3" not in commands[-4]
    assert "score_threshold=0.3" in commands[-4]
    capsys.readouterr()


def test_what_is_absent_is_left_out_with_a_word(commands, folders, tmp_path, monkeypatch, capsys):
    (row,) = measure(
        monkeypatch, tmp_path / "real.csv", {name: folders[name] for name in ("rooms", "lounge")}
    )
    said = capsys.readouterr().out
    assert f"rooms: left out, there is no folder {folders['rooms']}" in said
    assert "scan: left out, give --scan" in said
    assert (row["rooms_accuracy"], row["lounge_right"]) == ("", "2")
    with pytest.raises(SystemExit, match="nothing to measure on"):
        measure(monkeypatch, tmp_path / "real.csv", {})


def test_figures_of_one_commit_come_together_and_those_of_an_earlier_one_go(tmp_path):
    table = tmp_path / "real.csv"
    row = {
        "name": "a",
        "sha256": "1",
        "num_views": 24,
        "score_threshold": 0.5,
        "scenes": "all",
        "commit": "x",
    }
    other = row | {"sha256": "2", "name": "b", "rooms_accuracy": 0.1}
    assert [real_rows.keep_row(table, one) for one in (row | {"rooms_accuracy": 0.5}, other)] == [[], []]
    assert real_rows.keep_row(table, row | {"lounge_right": 3}) == []
    first, second = real_rows.read_kept(table)
    assert (first["rooms_accuracy"], first["lounge_right"]) == ("0.5", "3")
    assert second["rooms_accuracy"] == "0.1"
    assert real_rows.keep_row(table, row | {"lounge_right": 4, "commit": "y"}) == ["rooms"]
    assert real_rows.read_kept(table)[0]["rooms_accuracy"] == ""


def test_the_page_is_that_of_the_rows(project_root):
    table = project_root / "benchmarks" / "real.csv"
    assert table.with_suffix(".md").read_text() == real_rows.page(real_rows.read_kept(table))
