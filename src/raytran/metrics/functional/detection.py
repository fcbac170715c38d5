# SPDX-License-Identifier: Apache-2.0
"""Detections: greedy matching by score, precision, recall, F1, average precision, threshold of highest F1."""

from __future__ import annotations

from typing import TypedDict

import torch
from torch import Tensor

from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.structs import ObjectSet


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


def iou_within_class(predictions: ObjectSet, targets: ObjectSet) -> Tensor:
    """Return the exact IoU of predicted and true boxes, ``(P, M)``; 0 for those of different classes."""
    iou, _ = box_iou(
        OrientedBoxes(predictions.center, predictions.size, predictions.rotation),
        OrientedBoxes(targets.center, targets.size, targets.rotation),
    )
    return torch.where(predictions.label[:, None] == targets.label, iou, 0.0)


def score_order(score: Tensor) -> Tensor:
    """Return the order of descending scores, ``(P,)`` int64; equal scores stay in order, NaN comes last."""
    return score.nan_to_num(nan=-torch.inf).argsort(descending=True, stable=True)


def match_in_order(order: Tensor, allowed: Tensor, preference: Tensor | None = None) -> Tensor:
    """Give each prediction, one after another, one true object that is still free.

    Args:
        order: ``(P,)`` int64, the predictions in the order in which they choose.
        allowed: ``(P, M)`` bool, whether a prediction may take an object.
        preference: ``(P, M)``; a prediction takes the free object that it prefers most, the first among
            equals. None: the first free object.

    Returns:
        ``(P,)`` int64, the object of each prediction, or -1.
    """
    match = torch.full((allowed.shape[0],), -1, dtype=torch.int64, device=allowed.device)
    remaining = allowed.double() if preference is None else preference.double()
    remaining = torch.where(allowed, remaining, -torch.inf)
    for index in order[allowed[order].any(dim=1)].tolist():
        best, choice = remaining[index].max(dim=0)  # the first of equals
        if best > -torch.inf:
            match[index] = choice
            remaining[:, choice] = -torch.inf  # taken
    return match


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
        matched: ``(P,)`` bool, whether a prediction took a true object, or how many it took.
        n_true: number of true objects.

    Returns:
        The quality of the predictions with ``score >= score_threshold``, the highest of equally good
        thresholds. With no prediction the threshold is 0.
    """
    if score.numel() == 0:
        return BestScores(score_threshold=0.0, **detection_scores(0, 0, n_true))
    level, n_matched, n_predicted = _running_counts(score, matched)
    best = int((2 * n_matched.double() / (n_predicted + n_true)).argmax())  # the first of equals
    scores = detection_scores(int(n_matched[best]), int(n_predicted[best]), n_true)
    return BestScores(score_threshold=float(level[best]), **scores)


def average_precision(score: Tensor, matched: Tensor, n_true: int) -> float:
    """Return the area under the curve of precision against recall as the score threshold falls.

    As in PASCAL VOC from 2010 on: precision is the highest at this recall or a greater one, and all points
    of the curve count. Predictions of equal score enter together, so that their order does not matter.

    Args:
        score: ``(P,)`` of all predictions of all scenes.
        matched: ``(P,)`` bool, whether a prediction took a true object, or how many it took; precision is
            never counted above 1.
        n_true: number of true objects.

    Returns:
        A value in [0, 1]; 0 without predictions or without true objects.
    """
    if score.numel() == 0 or n_true == 0:
        return 0.0
    _, n_matched, n_predicted = _running_counts(score, matched)
    precision = (n_matched.double() / n_predicted).clamp(max=1)
    envelope = precision.flip(0).cummax(dim=0).values.flip(0)
    gained = n_matched.diff(prepend=n_matched.new_zeros(1))
    return float((envelope * gained).sum() / n_true)


def _running_counts(score: Tensor, matched: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return each score that occurs, highest first, and how many at or above it are matched and predicted."""
    values, order = score.sort(descending=True, stable=True)
    n_matched = matched[order].long().cumsum(dim=0)
    n_predicted = torch.arange(1, len(values) + 1, device=score.device)
    last_of_equals = torch.cat([values[1:] != values[:-1], torch.ones_like(values[:1], dtype=torch.bool)])
    return values[last_of_equals], n_matched[last_of_equals], n_predicted[last_of_equals]
