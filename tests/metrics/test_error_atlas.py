# SPDX-License-Identifier: Apache-2.0
"""Each cause of a miss on a scene made for it, and sums that must agree with the accuracy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from raytran.classes import PAPER_CLASSES
from raytran.metrics import Scan2CADAccuracy
from raytran.metrics.error_atlas import CAUSES, FATES, ErrorAtlas
from raytran.structs import ObjectSet

from .scenes import CHAIR, objects, random_scene

TABLE = PAPER_CLASSES.index("table")


CHAIR_HERE = objects([CHAIR], [[0, 0, 0]])


@pytest.mark.parametrize(
    ("prediction", "cause", "fate"),
    [
        (objects([CHAIR], [[0.1, 0, 0]]), "found", "match"),
        (objects([CHAIR], [[0.5, 0, 0]]), "translation", "misaligned"),
        (objects([CHAIR], [[0, 0, 0]], yaw=1.5708), "rotation", "misaligned"),
        (objects([CHAIR], [[0.25, 0, 0]], size=2.0), "scale", "misaligned"),
        (objects([TABLE], [[0.5, 0, 0]]), "wrong class", "wrong class"),
        (objects([CHAIR], [[1.0, 0, 0]]), "missed", "background"),  # half the diagonal is 0.866 m
        (objects([TABLE], [[1.0, 0, 0]]), "missed", "background"),
    ],
)
def test_cause(prediction, cause, fate):
    atlas = ErrorAtlas()
    atlas.update([prediction], [CHAIR_HERE], ["a"])
    assert atlas.rows()[0]["cause"] == cause
    result = atlas.compute()
    assert {name for name, count in result["predictions"].items() if count} == {fate}
    assert result["per_class"]["chair"][cause] == 1
    assert result["n_missed"] == (cause != "found")


def test_one_prediction_counts_once():
    pair = objects([CHAIR, CHAIR], [[0, 0, 0], [0.1, 0, 0]])
    atlas = ErrorAtlas()
    atlas.update([CHAIR_HERE], [pair], ["a"])
    assert [row["cause"] for row in atlas.rows()] == ["found", "duplicate"]
    atlas.reset()
    atlas.update([pair], [CHAIR_HERE], ["a"])
    assert atlas.compute()["predictions"] | {"match": 1, "duplicate": 1} == atlas.compute()["predictions"]


def test_the_class_comes_before_a_prediction_of_another():
    both = objects([TABLE, CHAIR], [[0, 0, 0], [0.6, 0, 0]])
    atlas = ErrorAtlas()
    atlas.update([both], [CHAIR_HERE], ["a"])
    assert atlas.rows()[0]["cause"] == "translation"


def test_outside_the_volume():
    targets = objects([CHAIR, CHAIR, CHAIR], [[4.6, 0, 0], [4.4, 0, 0], [0, 0, 1.8]])
    atlas = ErrorAtlas(volume_extent=(9.0, 9.0, 3.5))
    atlas.update([ObjectSet.empty()] * 2, [targets] * 2, ["known", "unknown"], [torch.zeros(3), None])
    causes = [row["cause"] for row in atlas.rows()]
    assert causes == ["outside the volume", "missed", "outside the volume", "missed", "missed", "missed"]


@pytest.mark.parametrize("seed", range(5))
def test_counts_agree_with_the_accuracy(seed):
    rng = np.random.default_rng(seed)
    atlas, accuracy = ErrorAtlas(), Scan2CADAccuracy()
    n_predicted = 0
    for index in range(5):
        predictions, targets = random_scene(rng)
        n_predicted += len(predictions)
        for metric in (atlas, accuracy):
            metric.update([predictions], [targets], [str(index)])
    result, expected = atlas.compute(), accuracy.compute()
    assert result["objects"]["found"] == result["predictions"]["match"] == expected["n_good"]
    assert sum(result["objects"].values()) == expected["n_total"]
    assert sum(result["predictions"].values()) == n_predicted
    assert [row["cause"] == "found" for row in atlas.rows()] == [row["matched"] for row in accuracy.rows()]
    assert set(result["objects"]) == set(CAUSES)
    assert set(result["predictions"]) == set(FATES)
