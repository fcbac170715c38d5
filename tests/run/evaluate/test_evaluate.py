# SPDX-License-Identifier: Apache-2.0
"""What an evaluation writes, with a network that knows the answer."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import pytest
import torch
from rich.console import Console
from torch import nn

from raytran.classes import PAPER_CLASSES
from raytran.errors import ConfigError
from raytran.geometry.rotation import rotation_from_yaw
from raytran.run.evaluate.evaluate import TASKS_WITH_SHAPE, evaluate_model, first_of, with_at_most
from raytran.run.evaluate.results import result_tables, write_evaluation
from raytran.structs import ObjectSet, SceneBatch, ScenePrediction, Views


class Oracle(nn.Module):
    """Predicts the objects it was told, with shapes where they are asked for."""

    grid_extent = (20.0, 20.0, 5.0)
    classes = PAPER_CLASSES
    score_threshold = 0.5

    def __init__(self, objects: ObjectSet) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))
        self.objects = objects
        self.thresholds: list[float] = []

    def forward(self, views, *, tasks, grid_center, views_at_once=None):
        assert set(tasks) == {"objects", "occupancy", "foreground"}

    def decode(self, raw, scene_ids, *, score_threshold=0.0, with_shapes=True):
        found = self.objects.select(self.objects.score >= score_threshold)
        if with_shapes:
            self.thresholds.append(score_threshold)
        else:
            found = replace(found, shape=None)
        return [ScenePrediction(scene_id, found, torch.zeros(3)) for scene_id in scene_ids]


def scene() -> SceneBatch:
    shape = torch.zeros(3, 8, 8, 8, dtype=torch.bool)
    shape[:, :4] = True
    objects = ObjectSet(
        label=torch.tensor([3, 3, 6]),
        center=torch.tensor([[0.0, 0, 0], [3.0, 0, 0], [6.0, 0, 0]]),
        size=torch.ones(3, 3),
        rotation=rotation_from_yaw(torch.zeros(3)),
        symmetry=torch.ones(3, dtype=torch.int64),
        score=torch.ones(3),
        shape=shape,
    )
    views = Views(torch.zeros(1, 1, 3, 16, 16), torch.eye(3)[None, None], torch.eye(4)[None, None])
    return SceneBatch(("a",), views, (("0",),), torch.zeros(1, 3), objects=(objects,))


def test_shapes_of_found_objects_are_compared(tmp_path):
    batch = scene()
    truth = batch.objects[0]
    half_right = truth.shape.float()
    half_right[1, :2] = 0.0
    model = Oracle(replace(truth, shape=half_right, score=torch.tensor([0.9, 0.8, 0.3])))
    output = tmp_path / "out"
    evaluation = evaluate_model(model, [batch], tasks=TASKS_WITH_SHAPE, progress=False)
    files = write_evaluation(output, evaluation)
    assert {path.name for path in output.iterdir()} == set(files)
    metrics = evaluation.metrics
    assert metrics["shape"]["n_matched"] == 2
    assert metrics["shape"]["iou"] == 0.75
    assert metrics["strict"]["n_good"] == 2
    assert model.thresholds == [0.5]  # shapes are decoded for what counts as predicted only
    assert metrics["strict"]["per_threshold"]["0.5"]["average_precision"] == 1.0  # sees every score
    assert json.loads((output / "metrics.json").read_text()) == metrics
    with (output / "per_object.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["shape_iou"] for row in rows] == ["1.0", "0.5", ""]
    assert [row["matched"] for row in rows] == ["True", "True", "False"]
    atlas = json.loads((output / "atlas.json").read_text())
    assert [(miss["object"], miss["cause"]) for miss in atlas["misses"]] == [(2, "missed")]
    calibration = metrics["strict"]["calibration"]
    assert calibration["counted"]["expected_error"] == pytest.approx((0.1 + 0.2) / 2)
    assert calibration["every_score"]["expected_error"] == pytest.approx((0.1 + 0.2 + 0.7) / 3)
    console = Console(width=100, record=True)
    console.print(*result_tables(evaluation, title="t"))
    said = console.export_text()
    assert "0.750" in said
    assert re.search(r"calibration error +0\.150", said)
    assert re.search(r"of every score +0\.333", said)


def test_nothing_found_is_told_too(tmp_path):
    batch = scene()
    model = Oracle(
        replace(batch.objects[0], shape=batch.objects[0].shape.float(), score=torch.full((3,), 0.1))
    )
    output = tmp_path / "out"
    evaluation = evaluate_model(model, [batch], tasks=TASKS_WITH_SHAPE, progress=False)
    write_evaluation(output, evaluation)
    metrics = evaluation.metrics
    assert metrics["shape"]["iou"] is None
    assert metrics["strict"]["global_average"] == 0
    assert "NaN" not in (output / "metrics.json").read_text()
    Console(quiet=True).print(*result_tables(evaluation, title="t"))


def test_shapes_are_left_alone_unless_asked_for():
    batch = scene()
    model = Oracle(replace(batch.objects[0], shape=batch.objects[0].shape.float()))
    assert "shape" not in evaluate_model(model, [batch], progress=False).metrics
    assert model.thresholds == []


def test_the_first_scenes_are_taken():
    scenes = list("abcde")
    assert [first_of(2, scenes)[index] for index in range(2)] == ["a", "b"]
    assert first_of(None, scenes) is first_of(9, scenes) is scenes


class Counted(list):
    """Scenes that are nothing but their number of objects."""

    def num_objects(self, index):
        return self[index]


def test_scenes_with_few_objects_are_chosen():
    scenes = Counted([12, 10, 31, 3])
    assert list(with_at_most(10, scenes)) == [10, 3]
    assert with_at_most(None, scenes) is scenes
    with pytest.raises(ConfigError, match="choose a larger max_objects"):
        with_at_most(2, scenes)


def test_mean_average_precision_beside_strict(tmp_path):
    batch = scene()
    model = Oracle(replace(batch.objects[0], shape=None, score=torch.tensor([0.9, 0.8, 0.3])))
    evaluation = evaluate_model(model, [batch], map_boxes="oriented", progress=False)
    write_evaluation(tmp_path / "out", evaluation)
    metrics = evaluation.metrics
    assert metrics["strict"]["n_good"] == 2
    assert metrics["map"]["iou_0.5"]["per_class"] == {"chair": 1.0, "table": 1.0}  # sees every score
    assert metrics["map"]["confidence"]["map_0.5"] == {"value": 1.0, "low": 1.0, "high": 1.0}
    with (tmp_path / "out" / "per_object.csv").open() as file:
        assert [row["map_matched_0.5"] for row in csv.DictReader(file)] == ["True"] * 3
    console = Console(width=100, record=True)
    console.print(*result_tables(evaluation, title="t"))
    assert "oriented boxes" in console.export_text()
