# SPDX-License-Identifier: Apache-2.0
"""Accuracy curves against the metric itself at other limits, and counts by scene size made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from raytran.metrics import Scan2CADAccuracy
from raytran.metrics.accuracy_curves import FACTORS, AccuracyCurves, accuracy_by_scene_size
from raytran.structs import ObjectSet

from .scenes import CHAIR, objects, random_scene


@pytest.mark.parametrize("seed", range(3))
def test_each_point_is_the_accuracy_at_its_limits(seed):
    rng = np.random.default_rng(seed)
    scenes = [random_scene(rng) for _ in range(4)]
    curves = AccuracyCurves()
    for index, (predictions, targets) in enumerate(scenes):
        curves.update([predictions], [targets], [str(index)])
    result = curves.compute()
    for step in (0, 4, 9, 19):
        for name, free in [("translation", (1, 0, 0)), ("rotation", (0, 1, 0)), ("joint", (1, 1, 1))]:
            limits = [
                round(limit * FACTORS[step], 6) if used else np.inf
                for limit, used in zip((0.2, 20.0, 0.2), free, strict=True)
            ]
            metric = Scan2CADAccuracy(max_translation=limits[0], max_rotation=limits[1], max_scale=limits[2])
            for index, (predictions, targets) in enumerate(scenes):
                metric.update([predictions], [targets], [str(index)])
            expected = metric.compute()
            assert result[name]["global_average"][step] == pytest.approx(expected["global_average"])
            assert result[name]["class_average"][step] == pytest.approx(expected["class_average"])


def test_one_object_appears_at_its_own_error():
    target = objects([CHAIR], [[0, 0, 0]])
    off = objects([CHAIR], [[0.3, 0, 0]], size=1.1)
    curves = AccuracyCurves()
    curves.update([off], [target], ["a"])
    result = curves.compute()
    first = {name: curve["global_average"].index(1.0) for name, curve in result.items()}
    assert result["translation"]["threshold"][first["translation"]] == 0.3
    assert first["rotation"] == 0
    assert result["scale"]["threshold"][first["scale"]] == 0.12  # 10 % and a rounding error of 1e-16
    assert result["joint"]["threshold"][first["joint"]] == 1.5
    assert curves.rows()[0]["found_from"] == 1.5


def test_no_scene_and_no_prediction():
    curves = AccuracyCurves()
    assert max(curves.compute()["joint"]["global_average"]) == 0
    curves.update([ObjectSet.empty()], [objects([CHAIR], [[0, 0, 0]])], ["a"])
    curves.update([objects([CHAIR], [[0, 0, 0]])], [ObjectSet.empty()], ["b"])
    assert max(curves.compute()["joint"]["class_average"]) == 0
    assert curves.rows()[0]["found_from"] is None


def test_scenes_with_few_objects():
    rows = [{"scene_id": "a", "category": "chair", "matched": index == 0} for index in range(10)]
    rows += [{"scene_id": "b", "category": "table", "matched": True} for _ in range(11)]
    result = accuracy_by_scene_size(rows, sizes=(5, 10, 20))
    assert result["5"] == {
        "class_average": 0,
        "global_average": 0,
        "n_good": 0,
        "n_total": 0,
        "n_scenes": 0,
    }
    assert (result["10"]["n_good"], result["10"]["n_total"], result["10"]["n_scenes"]) == (1, 10, 1)
    assert result["20"]["class_average"] == pytest.approx((0.1 + 1) / 2)
    assert result["20"]["global_average"] == pytest.approx(12 / 21)
    assert result["20"]["n_scenes"] == 2
