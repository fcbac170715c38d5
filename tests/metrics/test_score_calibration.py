# SPDX-License-Identifier: Apache-2.0
"""Whether boxes are right is what box F1 says; what follows is tested beside the function."""

from __future__ import annotations

import numpy as np
import pytest

from raytran.errors import ConfigError
from raytran.metrics import OrientedBoxF1, ScoreCalibration

from .scenes import objects, random_scene


def test_boxes_are_right_as_in_box_f1():
    rng = np.random.default_rng(0)
    scenes = [random_scene(rng) for _ in range(20)]
    names = [str(index) for index in range(20)]
    calibration, box_f1 = ScoreCalibration(iou_threshold=0.5), OrientedBoxF1()
    for metric in (calibration, box_f1):
        metric.update(*zip(*scenes, strict=True), names)
    found, expected = calibration.compute(), box_f1.compute()["per_threshold"]["0.5"]
    assert (found["n_predicted"], found["n_right"]) == (expected["n_predicted"], expected["n_matched"])
    assert 0 < found["n_right"] < found["n_predicted"]
    assert found["scaling"]["scale"] > 0 or found["scaling"] is None
    rows = zip(calibration.rows(), box_f1.rows(), strict=True)
    assert all(one["found"] == other["matched_0.5"] for one, other in rows)
    rows = zip(calibration.rows("scene"), box_f1.rows("scene"), strict=True)
    assert all(one["n_right"] == other["n_matched_0.5"] for one, other in rows)


def test_a_hand_reckoned_case():
    """Two boxes on one object, of scores 0.9 and 0.8, and one of 0.6 where there is nothing."""
    truth = objects([3, 3], [[0, 0, 0], [5, 0, 0]])
    found = objects([3, 3, 3], [[0, 0, 0], [0.1, 0, 0], [9, 0, 0]], score=np.array([0.8, 0.9, 0.6]))
    metric = ScoreCalibration()
    metric.update([found], [truth], ["a"])
    result = metric.compute()
    assert (result["n_predicted"], result["n_right"]) == (3, 1)
    assert result["expected_error"] == pytest.approx((0.1 + 0.8 + 0.6) / 3)
    assert [row["found"] for row in metric.rows()] == [True, False]


def test_other_classes_are_not_right_and_no_bin_is_refused():
    metric = ScoreCalibration()
    metric.update([objects([4], [[0, 0, 0]])], [objects([3], [[0, 0, 0]])], ["a"])
    result = metric.compute()
    assert (result["expected_error"], result["scaling"]) == (1.0, None)
    with pytest.raises(ConfigError, match="0 bins of scores are too few"):
        ScoreCalibration(num_bins=0)
