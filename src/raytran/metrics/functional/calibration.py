# SPDX-License-Identifier: Apache-2.0
"""Whether scores mean what they say: the share of right predictions against their scores."""

from __future__ import annotations

import math
from typing import TypedDict

import torch
from torch import Tensor

from raytran.heads.score_scaling import ScoreScaling

NUM_BINS = 10
"""Intervals of scores: the last holds those from 0.9 on."""

_NEAREST = 1e-6
"""Scores nearer to 0 or 1 than this are taken for that far away: their logarithms would be infinite."""

_MOST_STEPS = 100
_SETTLED = 1e-10
"""Newton's method ends with a step of which both parts are shorter."""


class Bin(TypedDict):
    """Predictions with scores in [low, high), the last bin with 1 too; means are None where none are."""

    low: float
    high: float
    n_predicted: int
    mean_score: float | None
    share_right: float | None


class Reliability(TypedDict):
    """How scores and shares of right predictions go together; ``expected_error`` is None without any."""

    expected_error: float | None
    n_predicted: int
    n_right: int
    bins: list[Bin]


def reliability(score: Tensor, right: Tensor, *, num_bins: int = NUM_BINS) -> Reliability:
    """Return the expected calibration error, and what it is the mean of.

    The error is the mean over all predictions of |mean score − share of right ones| in the prediction's bin
    (Naeini et al., Obtaining well calibrated probabilities using Bayesian binning, 2015). Bins are equally
    wide. The result does not depend on the order of the predictions, to the last bit.

    Args:
        score: ``(P,)`` in [0, 1].
        right: ``(P,)`` bool.
        num_bins: number of bins.
    """
    edges = torch.arange(1, num_bins, dtype=torch.float64) / num_bins
    place = torch.bucketize(score.double().contiguous(), edges, right=True)
    bins, gaps = [], []
    for index in range(num_bins):
        within = place == index
        count, n_right = int(within.sum()), int(right[within].sum())
        total = math.fsum(score[within].tolist())
        bins.append(
            Bin(
                low=index / num_bins,
                high=(index + 1) / num_bins,
                n_predicted=count,
                mean_score=total / count if count else None,
                share_right=n_right / count if count else None,
            )
        )
        gaps.append(abs(total - n_right))
    return Reliability(
        expected_error=math.fsum(gaps) / len(score) if len(score) else None,
        n_predicted=len(score),
        n_right=int(right.sum()),
        bins=bins,
    )


def fit_scaling(score: Tensor, right: Tensor) -> ScoreScaling | None:
    """Return the scaling under which it is likeliest that just these predictions are right.

    Newton's method on the logarithm of the likelihood, which is concave, with steps halved until they lead
    upwards. As in Platt's paper right and wrong predictions count as such with a little doubt,
    (n + 1) / (n + 2) for n of them: else scores that tell all apart would be stretched without end.

    Args:
        score: ``(P,)`` in [0, 1].
        right: ``(P,)`` bool.

    Returns:
        None if there are no right or no wrong ones, or if the right ones have no higher scores.
    """
    n_right, n_wrong = int(right.sum()), int((~right).sum())
    if not n_right or not n_wrong:
        return None
    # In the order of the scores: sums are then the same to the last bit in whatever order scenes came.
    order = torch.argsort(score + 2.0 * right, stable=True)
    logit = score[order].double().clamp(_NEAREST, 1 - _NEAREST).logit()
    wanted = torch.where(right[order], (n_right + 1) / (n_right + 2), 1 / (n_wrong + 2)).double()
    inputs = torch.stack([logit, torch.ones_like(logit)], dim=-1)
    weights = torch.tensor([1.0, 0.0], dtype=torch.float64)

    def loss(weights: Tensor) -> float:
        found = inputs @ weights
        return float(torch.nn.functional.binary_cross_entropy_with_logits(found, wanted, reduction="sum"))

    for _ in range(_MOST_STEPS):
        probability = (inputs @ weights).sigmoid()
        gradient = inputs.T @ (probability - wanted)
        curvature = inputs.T @ (inputs * (probability * (1 - probability))[:, None])
        curvature += 1e-12 * torch.eye(2, dtype=torch.float64)
        step, here = torch.linalg.solve(curvature, gradient), loss(weights)
        while float(step.abs().max()) > _SETTLED and loss(weights - step) > here:
            step = step / 2
        weights = weights - step
        if float(step.abs().max()) <= _SETTLED:
            break
    scale, offset = weights.tolist()
    return ScoreScaling(scale, offset) if scale > 0 else None
