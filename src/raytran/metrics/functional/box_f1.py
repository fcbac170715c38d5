# SPDX-License-Identifier: Apache-2.0
"""Precision, recall and F1 of detected objects, and the score threshold at which F1 is highest."""

from __future__ import annotations

from typing import TypedDict

import torch
from torch import Tensor


class DetectionScores(TypedDict):
    """Quality of one set of predictions; ratios with nothing to count are 0."""

    precision: float
    recall: float
    f1: float
    n_predicted: int
    n_true: int
    n_matched: int


class BestScores(DetectionScores):
    """Quality of the predictions with at least a score."""

    score_threshold: float


def detection_scores(n_matched: int, n_predicted: int, n_true: int) -> DetectionScores:
    """Return precision, recall and their harmonic mean with the counts they come from."""
    return DetectionScores(
        precision=n_matched / max(n_predicted, 1),
        recall=n_matched / max(n_true, 1),
        f1=2 * n_matched / max(n_predicted + n_true, 1),
        n_predicted=n_predicted,
        n_true=n_true,
        n_matched=n_matched,
    )


def best_f1(score: Tensor, matched: Tensor, n_true: int) -> BestScores:
    """Find the score threshold of highest F1 in one pass over the sorted predictions.

    Matching goes in the order of the scores, so leaving out the predictions below a threshold changes no
    match above it, and the counts at every threshold are running sums.

    Args:
        score: ``(P,)`` of all predictions of all scenes.
        matched: ``(P,)`` bool, whether a prediction took a true object.
        n_true: number of true objects.

    Returns:
        The quality of the predictions with ``score >= score_threshold``, the highest of equally good
        thresholds. With no prediction the threshold is 0.
    """
    if score.numel() == 0:
        return BestScores(score_threshold=0.0, **detection_scores(0, 0, n_true))
    values, order = score.sort(descending=True, stable=True)
    n_matched = matched[order].long().cumsum(dim=0)
    n_predicted = torch.arange(1, len(values) + 1, device=score.device)
    f1 = 2 * n_matched / (n_predicted + n_true)
    last_of_equals = torch.cat([values[1:] != values[:-1], torch.ones_like(matched[:1])])
    best = int(torch.where(last_of_equals, f1, -1.0).argmax())
    chosen = detection_scores(int(n_matched[best]), best + 1, n_true)
    return BestScores(score_threshold=float(values[best]), **chosen)
