# SPDX-License-Identifier: Apache-2.0
"""Intervals and p-values against formulas, enumeration, and cases with a known answer."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from raytran.metrics.bootstrap import (
    bootstrap_interval,
    class_average,
    class_counts,
    compare_paired,
    f1,
    global_average,
)


def row(scene: str, category: str, matched: bool) -> dict:
    return {"scene_id": scene, "category": category, "matched": matched}


ROWS = [row("a", "chair", True), row("a", "chair", False), row("b", "table", True), row("x", "sofa", True)]


def test_counts_and_averages_by_hand():
    counts = class_counts(ROWS, ["b", "a", "empty"])
    assert counts.shape == (3, 18)
    assert counts.sum(axis=0).nonzero()[0].tolist() == [3, 6, 9 + 3, 9 + 6]
    total = counts.sum(axis=0)
    assert float(global_average(total)) == pytest.approx(2 / 3)
    assert float(class_average(total)) == pytest.approx((1 / 2 + 1) / 2)
    assert float(f1(np.array([3.0, 4.0, 8.0]))) == pytest.approx(2 * 0.75 * 0.375 / 1.125)


def test_interval_has_the_width_that_theory_gives():
    rng = np.random.default_rng(0)
    good = rng.binomial(1, 0.4, 400)
    counts = np.zeros((400, 18))
    counts[:, 3], counts[:, 12] = good, 1
    interval = bootstrap_interval(counts, global_average)
    share = float(good.mean())
    half = 1.96 * np.sqrt(share * (1 - share) / 400)
    assert interval["value"] == pytest.approx(share)
    assert interval["high"] - share == pytest.approx(half, rel=0.1)
    assert share - interval["low"] == pytest.approx(half, rel=0.1)
    assert interval == bootstrap_interval(counts, global_average)
    assert interval != bootstrap_interval(counts, global_average, seed=1)


def test_scenes_are_drawn_whole():
    counts = np.zeros((2, 18))
    counts[0, 3] = 100
    counts[:, 12] = 100
    interval = bootstrap_interval(counts, global_average)
    assert (interval["low"], interval["high"]) == (0, 1)


def test_p_value_equals_that_of_all_permutations():
    rng = np.random.default_rng(1)
    true = np.full(10, 6)
    good = [rng.integers(0, 7, 10), rng.integers(0, 5, 10)]
    sides = [np.zeros((10, 18)) for _ in good]
    for side, values in zip(sides, good, strict=True):
        side[:, 3], side[:, 12] = values, true
    observed = abs((good[0] - good[1]).sum())
    signs = np.array(list(itertools.product([1, -1], repeat=10)))
    expected = (np.abs(signs @ (good[0] - good[1])) >= observed).mean()
    drawn = compare_paired(*sides, global_average, num_resamples=1000)
    assert drawn["p_value"] == pytest.approx(expected, abs=0.03)
    found = compare_paired(*sides, global_average, num_resamples=20000)  # more than there are: all of them
    assert found["p_value"] == pytest.approx(expected)
    assert found["difference"] == pytest.approx((good[0] - good[1]).sum() / 60)
    assert found["low"] <= found["difference"] <= found["high"]


def test_equal_results_do_not_differ():
    counts = class_counts(ROWS, ["a", "b"])
    found = compare_paired(counts, counts, class_average)
    assert (found["difference"], found["low"], found["high"]) == (0, 0, 0)
    assert found["p_value"] == 1
    assert not found["significant"]


def test_a_clear_difference_is_significant():
    better, worse = (np.zeros((30, 18)) for _ in range(2))
    better[:, 3], worse[:, 3] = 4, 1
    better[:, 12] = worse[:, 12] = 5
    found = compare_paired(better, worse, global_average)
    assert found["significant"]
    assert found["difference"] == pytest.approx(0.6)
    assert compare_paired(worse, better, global_average)["difference"] == pytest.approx(-0.6)


def test_one_scene_says_nothing_of_chance():
    counts = class_counts(ROWS, ["a"])
    assert bootstrap_interval(counts, global_average) == {"value": 0.5, "low": 0.5, "high": 0.5}
    assert compare_paired(counts, 0 * counts, global_average)["p_value"] == 1


def test_no_scene():
    none = np.zeros((0, 18))
    assert bootstrap_interval(none, global_average) == {"value": 0, "low": 0, "high": 0}
    assert compare_paired(none, none, global_average)["p_value"] == 1
