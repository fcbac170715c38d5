# SPDX-License-Identifier: Apache-2.0
"""The scores of a split: what counts as predicted, and what another threshold would have given."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torchmetrics import SumMetric

from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import ObjectSet, SceneBatch, ScenePrediction, Views
from raytran.training.scores import SceneScores


def objects(centers: list[list[float]], scores: list[float]) -> ObjectSet:
    count = len(centers)
    return ObjectSet(
        label=torch.full((count,), 3),
        center=torch.tensor(centers),
        size=torch.ones(count, 3),
        rotation=rotation_from_yaw(torch.zeros(count)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.tensor(scores),
    )


def batch(truth: ObjectSet) -> SceneBatch:
    views = Views(torch.zeros(1, 1, 3, 16, 16), torch.eye(3)[None, None], torch.eye(4)[None, None])
    return SceneBatch(("a",), views, (("0",),), torch.zeros(1, 3), objects=(truth,))


def test_threshold_counts_and_best_looks_below_it() -> None:
    truth = objects([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [1.0, 1.0])
    found = objects([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 0.0]], [0.9, 0.4, 0.1])
    scores = SceneScores(tasks=["objects"], score_threshold=0.5, duplicate_iou=None)
    scores.update(batch(truth), [ScenePrediction("a", found, torch.zeros(3))])
    results = scores.results()
    assert results["strict"]["n_good"] == 1
    at_half = results["strict"]["per_threshold"]["0.5"]
    assert (at_half["n_predicted"], at_half["n_matched"]) == (1, 1)
    assert at_half["best"]["f1"] == pytest.approx(1.0)
    assert at_half["best"]["score_threshold"] == pytest.approx(0.4)
    assert at_half["average_precision"] == pytest.approx(1.0)
    assert set(results) == {"strict"}


def test_numbers_of_each_class_that_is_there() -> None:
    truth = objects([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [1.0, 1.0])
    truth = replace(truth, label=torch.tensor([3, 5]))
    # A chair found, a sofa missed, and a table where there is none.
    found = objects([[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]], [0.9, 0.9])
    found = replace(found, label=torch.tensor([3, 6]))
    scores = SceneScores(tasks=["objects"])
    scores.update(batch(truth), [ScenePrediction("a", found, torch.zeros(3))])
    numbers = scores.compute()
    assert {name: value for name, value in numbers.items() if name.startswith("objects/accuracy/")} == {
        "objects/accuracy/chair": 1.0,
        "objects/accuracy/sofa": 0.0,
    }
    assert {name: value for name, value in numbers.items() if name.startswith("objects/f1_0.5/")} == {
        "objects/f1_0.5/chair": 1.0,
        "objects/f1_0.5/sofa": 0.0,
    }


def test_only_metrics_of_the_tasks() -> None:
    truth = objects([[0.0, 0.0, 0.0]], [1.0])
    scores = SceneScores(tasks=["objects"])
    scores.update(batch(truth), [ScenePrediction("a", truth, torch.zeros(3))])
    assert set(scores.compute()) == {
        "objects/accuracy_global",
        "objects/accuracy_class",
        "objects/f1_0.25",
        "objects/f1_0.5",
        "objects/accuracy/chair",
        "objects/f1_0.25/chair",
        "objects/f1_0.5/chair",
    }
    scores.reset()
    assert scores.results()["strict"]["n_total"] == 0


class Found(SumMetric):
    def update(self, batch, predictions) -> None:
        super().update(sum(len(prediction.objects) for prediction in predictions))


def test_metrics_of_ones_own() -> None:
    truth = objects([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [1.0, 0.1])
    scores = SceneScores(tasks=[], metrics={"found": Found()})
    scores.update(batch(truth), [ScenePrediction("a", truth, torch.zeros(3))])
    assert scores.results() == scores.compute() == {"found": 2.0}
    scores.reset()
    assert scores.compute() == {"found": 0.0}


def test_mean_average_precision_of_predictions_of_every_score() -> None:
    truth = objects([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [1.0, 1.0])
    found = objects([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [0.9, 0.4, 0.1])
    scores = SceneScores(tasks=["objects"], map_boxes="axis_aligned")
    scores.update(batch(truth), [ScenePrediction("a", found, torch.zeros(3))])
    expected = pytest.approx((1 + 2 / 3) / 2)
    assert scores.results()["map"]["iou_0.5"]["mean"] == expected
    numbers = scores.compute()
    assert (numbers["objects/map_0.25"], numbers["objects/map_0.5/chair"]) == (expected, expected)
    assert [row["map_matched_0.5"] for row in scores.rows("object")] == [True, True]
    assert [row["matched_0.5"] for row in scores.rows("object")] == [True, False]
    scores.reset()
    assert scores.results()["map"]["n_true"] == {}
    assert "map" not in SceneScores(tasks=["objects"]).results()
