# SPDX-License-Identifier: Apache-2.0
"""How far a number may be chance: bootstrap over scenes, and the comparison of two sets of predictions.

Scenes, not objects, are drawn (Efron and Tibshirani, *An Introduction to the Bootstrap*, 1993), since the
objects of one room are not independent of each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypedDict

import torch
from torch import Tensor

from raytran.metrics.records import Row
from raytran.structs import CLASSES

Statistic = Callable[[Tensor], Tensor]
"""From summed counts ``(R, C)`` to a number each, ``(R,)``."""

CONFIDENCE = 0.95


class Interval(TypedDict):
    """A number with its percentile interval."""

    value: float
    low: float
    high: float


class Comparison(TypedDict):
    """Difference of two numbers measured on the same scenes, first minus second.

    ``p_value`` is that of a two-sided permutation test: how often a difference at least as large arises if
    in each scene it is left to chance which of the two results belongs to which side.
    """

    first: float
    second: float
    difference: float
    low: float
    high: float
    p_value: float
    significant: bool
    n_scenes: int


def class_counts(rows: Iterable[Row], scene_ids: Sequence[str], classes: Sequence[str] = CLASSES) -> Tensor:
    """Return found and annotated objects of each class in each scene.

    Args:
        rows: a row for each object with ``scene_id``, ``category`` and ``matched``; those of scenes that are
            not in ``scene_ids`` are left out.
        scene_ids: the ``S`` scenes, also those without objects.
        classes: the ``K`` names that ``category`` may be.

    Returns:
        ``(S, 2 K)`` float64: the ``K`` classes' found objects, then their annotated objects.
    """
    position = {scene_id: index for index, scene_id in enumerate(scene_ids)}
    counts = torch.zeros(len(scene_ids), 2, len(classes), dtype=torch.float64)
    index = [
        (position[str(row["scene_id"])], classes.index(str(row["category"])), bool(row["matched"]))
        for row in rows
        if row["scene_id"] in position
    ]
    if index:
        scene, label, good = torch.tensor(index).T
        counts[:, 0].index_put_((scene, label), good.double(), accumulate=True)
        counts[:, 1].index_put_((scene, label), torch.ones(len(scene)).double(), accumulate=True)
    return counts.flatten(1)


def class_average(counts: Tensor) -> Tensor:
    """Return the mean accuracy over the classes that occur, from ``(R, 2 K)`` of ``class_counts``."""
    good, total = counts.unflatten(1, (2, -1)).unbind(dim=1)
    return (good / total.clamp(min=1)).sum(dim=1) / (total > 0).sum(dim=1).clamp(min=1)


def global_average(counts: Tensor) -> Tensor:
    """Return the share of all objects that are found, from ``(R, 2 K)`` of ``class_counts``."""
    good, total = counts.unflatten(1, (2, -1)).sum(dim=-1).unbind(dim=1)
    return good / total.clamp(min=1)


def f1(counts: Tensor) -> Tensor:
    """Return F1 from ``(R, 3)``: matches, predictions, annotated objects."""
    matched, predicted, true = counts.unbind(dim=1)
    return 2 * matched / (predicted + true).clamp(min=1)


def bootstrap_interval(
    counts: Tensor, statistic: Statistic, *, num_resamples: int = 2000, seed: int = 0
) -> Interval:
    """Return a number and the 95 % interval of its values over scenes drawn with replacement.

    Args:
        counts: ``(S, C)`` float64, what each scene adds to the sums that ``statistic`` is computed from.
        statistic: e.g. ``global_average``.
        num_resamples: how often to draw.
        seed: of the drawing; the same seed and scenes give the same interval.
    """
    value = float(statistic(counts.sum(dim=0, keepdim=True)))
    if not len(counts):
        return Interval(value=value, low=value, high=value)
    low, high = _percentiles(statistic(_weights(len(counts), num_resamples, seed) @ counts))
    return Interval(value=value, low=low, high=high)


def compare_paired(
    first: Tensor, second: Tensor, statistic: Statistic, *, num_resamples: int = 2000, seed: int = 0
) -> Comparison:
    """Compare two results on the same scenes.

    Args:
        first: ``(S, C)`` float64, as for ``bootstrap_interval``.
        second: ``(S, C)`` of the same scenes in the same order.
        statistic: e.g. ``global_average``.
        num_resamples: number of bootstrap draws, and of permutations.
        seed: of both.

    Returns:
        The difference, its bootstrap interval (the same scenes drawn for both sides), and the p-value of the
        permutation test; ``significant`` if that is below 5 %.
    """

    def difference(a: Tensor, b: Tensor) -> Tensor:
        return statistic(a) - statistic(b)

    values = [float(statistic(side.sum(dim=0, keepdim=True))) for side in (first, second)]
    observed = values[0] - values[1]
    low = high = observed
    p_value = 1.0
    if len(first):
        weights = _weights(len(first), num_resamples, seed)
        low, high = _percentiles(difference(weights @ first, weights @ second))
        generator = torch.Generator().manual_seed(seed + 1)
        swap = torch.randint(0, 2, (num_resamples, len(first)), generator=generator).double()
        moved = swap @ (second - first)
        by_chance = difference(first.sum(dim=0) + moved, second.sum(dim=0) - moved).abs()
        # The arrangement that was observed is one of those possible, so p is never 0.
        p_value = (1 + int((by_chance >= abs(observed) - 1e-12).sum())) / (1 + num_resamples)
    return Comparison(
        first=values[0],
        second=values[1],
        difference=observed,
        low=low,
        high=high,
        p_value=p_value,
        significant=p_value < 1 - CONFIDENCE,
        n_scenes=len(first),
    )


def _weights(num_scenes: int, num_resamples: int, seed: int) -> Tensor:
    """Return how often each scene is drawn, ``(R, S)`` float64 with rows that sum to ``S``."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(0, num_scenes, (num_resamples, num_scenes), generator=generator)
    weights = torch.zeros(num_resamples, num_scenes, dtype=torch.float64)
    return weights.scatter_add_(1, drawn, torch.ones_like(weights))


def _percentiles(values: Tensor) -> tuple[float, float]:
    tail = (1 - CONFIDENCE) / 2
    low, high = torch.quantile(values, torch.tensor([tail, 1 - tail], dtype=torch.float64)).tolist()
    return low, high
