# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest
import torch

from raytran.errors import ConfigError
from raytran.heads.objects import objects_of_queries
from raytran.heads.score_scaling import ScoreScaling
from raytran.structs import RawObjects


def raw_objects(count=6):
    generator = torch.Generator().manual_seed(0)

    def numbers(width):
        return torch.randn(1, count, width, generator=generator)

    return RawObjects(
        class_logits=3 * numbers(10),
        center=numbers(3),
        log_size=numbers(3),
        yaw_vector=numbers(2),
        embedding=numbers(8),
    )


def test_scores_are_scaled_on_log_odds_and_nothing_else_changes():
    raw, scaling = raw_objects(), ScoreScaling(0.5, -0.4)
    plain, _ = objects_of_queries(raw, 0)
    scaled, _ = objects_of_queries(raw, 0, score_scaling=scaling)
    for before, after in zip(plain.score.tolist(), scaled.score.tolist(), strict=True):
        odds = math.exp(-0.4) * (before / (1 - before)) ** 0.5
        assert after == pytest.approx(odds / (1 + odds), rel=1e-5)
    for name in ("label", "center", "size", "rotation"):
        assert torch.equal(getattr(plain, name), getattr(scaled, name))


def test_the_threshold_is_one_of_scaled_scores():
    raw, scaling = raw_objects(), ScoreScaling(0.5, -0.4)
    every, _ = objects_of_queries(raw, 0, score_scaling=scaling)
    threshold = every.score[2].item()
    kept, embedding = objects_of_queries(raw, 0, score_scaling=scaling, score_threshold=threshold)
    assert torch.equal(kept.score, every.score[:3])
    assert len(embedding) == 3
    assert len(objects_of_queries(raw, 0, score_threshold=threshold)[0]) > 3


def test_certainty_stays_and_one_after_another_is_one():
    first, then = ScoreScaling(2.0, 1.0), ScoreScaling(0.5, -3.0)
    score = torch.tensor([0.0, 0.2, 0.5, 0.99, 1.0], dtype=torch.float64)
    both = then.after(first)
    assert both == ScoreScaling(1.0, -2.5)
    assert torch.allclose(both(score), then(first(score)))
    assert both(score)[[0, -1]].tolist() == [0.0, 1.0]
    assert then.after(None) == then
    assert [one.of_half for one in (first, then)] == [
        pytest.approx(one(score)[2].item()) for one in (first, then)
    ]


def test_settings_are_checked():
    assert ScoreScaling.of(None) is None
    assert ScoreScaling.of(ScoreScaling(0.5, 1.0).settings()) == ScoreScaling(0.5, 1.0)
    for settings in (
        {"scale": -1.0, "offset": 0.0},
        {"scale": 1.0},
        {"scale": 1.0, "offset": float("nan")},
        "0.5",
        {"scale": "x", "offset": 0},
    ):
        with pytest.raises(ConfigError, match="is no pair of a scale and an offset"):
            ScoreScaling.of(settings)
