# SPDX-License-Identifier: Apache-2.0
"""Calibration against plain loops, and the fit against SciPy's minimiser."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from raytran.heads.score_scaling import ScoreScaling
from raytran.metrics.functional.calibration import fit_scaling, reliability


def predictions(count, seed=0):
    """Scores of a network that is too sure of itself, and whether each is right."""
    rng = np.random.default_rng(seed)
    logit = rng.normal(0, 3, count)
    right = rng.random(count) < 1 / (1 + np.exp(-(0.5 * logit - 0.7)))
    return torch.as_tensor(1 / (1 + np.exp(-logit))), torch.as_tensor(right)


def slow_error(score, right, num_bins):
    bins = {}
    for one, is_right in zip(score.tolist(), right.tolist(), strict=True):
        bins.setdefault(min(int(one * num_bins), num_bins - 1), []).append((one, is_right))
    gaps = [abs(sum(s for s, _ in group) - sum(r for _, r in group)) for group in bins.values()]
    return sum(gaps) / len(score)


@pytest.mark.parametrize("num_bins", [1, 4, 10])
def test_equals_plain_loops(num_bins):
    score, right = predictions(500)
    found = reliability(score, right, num_bins=num_bins)
    assert found["expected_error"] == pytest.approx(slow_error(score, right, num_bins), abs=1e-12)
    assert num_bins == 1 or found["expected_error"] > 0.1
    assert sum(part["n_predicted"] for part in found["bins"]) == found["n_predicted"] == 500
    assert found["n_right"] == int(right.sum())


def test_the_edges_of_bins():
    score = torch.tensor([0.0, 0.0999, 0.1, 0.3, 0.6, 0.7, 0.9, 1.0], dtype=torch.float64)
    found = reliability(score, torch.ones(8, dtype=torch.bool))
    counts = [part["n_predicted"] for part in found["bins"]]
    assert counts == [2, 1, 0, 1, 0, 0, 1, 1, 0, 2]
    assert found["bins"][2]["mean_score"] is found["bins"][2]["share_right"] is None
    assert found["bins"][9]["mean_score"] == pytest.approx(0.95)


def test_sure_and_always_right_is_no_error_and_nothing_is_none():
    assert reliability(torch.ones(4), torch.ones(4, dtype=torch.bool))["expected_error"] == 0
    assert reliability(torch.ones(4), torch.zeros(4, dtype=torch.bool))["expected_error"] == 1
    nothing = reliability(torch.zeros(0), torch.zeros(0, dtype=torch.bool))
    assert (nothing["expected_error"], nothing["n_predicted"]) == (None, 0)


def test_the_fit_is_that_of_a_general_minimiser():
    score, right = predictions(400)
    fitted = fit_scaling(score, right)
    n_right, n_wrong = int(right.sum()), int((~right).sum())
    wanted = np.where(right, (n_right + 1) / (n_right + 2), 1 / (n_wrong + 2))
    logit = np.log(score.numpy() / (1 - score.numpy()))

    def loss(weights):
        p = 1 / (1 + np.exp(-(weights[0] * logit + weights[1])))
        return -(wanted * np.log(p) + (1 - wanted) * np.log(1 - p)).sum()

    best = minimize(loss, [1.0, 0.0], tol=1e-10).x
    assert (fitted.scale, fitted.offset) == pytest.approx(tuple(best), abs=1e-4)
    assert fitted.scale == pytest.approx(0.5, abs=0.15)


def test_the_fit_mends_scores_and_knows_nothing_of_order():
    score, right = predictions(2000)
    fitted = fit_scaling(score, right)
    before, after = (reliability(s, right)["expected_error"] for s in (score, fitted(score)))
    assert before > 0.1
    assert after < 0.05
    shuffled = torch.randperm(2000, generator=torch.Generator().manual_seed(1))
    assert fit_scaling(score[shuffled], right[shuffled]) == fitted
    new_score, new_right = predictions(2000, seed=1)
    assert reliability(fitted(new_score), new_right)["expected_error"] < 0.05


def test_scores_that_tell_all_apart_are_not_stretched_without_end():
    score = torch.tensor([0.1, 0.2, 0.8, 0.9])
    fitted = fit_scaling(score, score > 0.5)
    assert fitted == fit_scaling(score, score > 0.5)
    assert 0 < fitted.scale < 5
    assert math.isfinite(fitted.offset)
    certain = fit_scaling(torch.tensor([0.0, 1.0]), torch.tensor([False, True]))
    assert math.isfinite(certain.scale)


@pytest.mark.parametrize(
    ("score", "right"),
    [([], []), ([0.5, 0.7], [True, True]), ([0.5, 0.7], [False, False]), ([0.9, 0.2], [False, True])],
)
def test_scores_that_tell_nothing_give_no_fit(score, right):
    assert fit_scaling(torch.tensor(score), torch.tensor(right, dtype=torch.bool)) is None


def test_a_fit_to_scaled_scores_goes_behind_the_first():
    score, right = predictions(800)
    first = ScoreScaling(0.8, 0.3)
    again = fit_scaling(first(score), right).after(first)
    at_once = fit_scaling(score, right)
    assert (again.scale, again.offset) == pytest.approx((at_once.scale, at_once.offset), rel=1e-6)
