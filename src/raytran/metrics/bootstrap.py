# SPDX-License-Identifier: Apache-2.0
"""How far a number may be chance: bootstrap over scenes, and the comparison of two sets of predictions.

Scenes, not objects, are drawn (Efron and Tibshirani, *An Introduction to the Bootstrap*, 1993), since the
objects of one room are not independent of each other. ``scipy.stats`` draws and counts; it resamples the
numbers of the scenes, whose counts are then summed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap, permutation_test

from raytran.classes import PAPER_CLASSES
from raytran.metrics.per_scene import Row

Counts = NDArray[np.float64]

Statistic = Callable[[Counts], Counts]
"""From summed counts ``(..., C)`` to a number each, ``(...,)``."""

OfScenes = Callable[[NDArray[np.int64]], Counts]
"""From drawn scenes ``(..., S)``, some of them several times, to a number each, ``(...,)``."""

CONFIDENCE = 0.95

_BATCH = 100
"""Draws that are counted together: their counts are in memory at once."""


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


def class_counts(
    rows: Iterable[Row], scene_ids: Sequence[str], classes: Sequence[str] = PAPER_CLASSES.names
) -> Counts:
    """Return found and annotated objects of each class in each scene.

    Args:
        rows: a row for each object with ``scene_id``, ``category`` and ``matched``; those of scenes that are
            not in ``scene_ids`` are left out.
        scene_ids: the ``S`` scenes, also those without objects.
        classes: the ``K`` names that ``category`` may be.

    Returns:
        ``(S, 2 K)``: the ``K`` classes' found objects, then their annotated objects.
    """
    scene_index = {scene_id: index for index, scene_id in enumerate(scene_ids)}
    counts = np.zeros((len(scene_ids), 2, len(classes)))
    for row in rows:
        scene = scene_index.get(str(row["scene_id"]))
        if scene is not None:
            label = classes.index(str(row["category"]))
            counts[scene, 0, label] += bool(row["matched"])
            counts[scene, 1, label] += 1
    return counts.reshape(len(scene_ids), -1)


def class_average(counts: Counts) -> Counts:
    """Return the mean accuracy over the classes that occur, from ``(..., 2 K)`` of ``class_counts``."""
    good, total = np.split(counts, 2, axis=-1)
    return (good / np.maximum(total, 1)).sum(axis=-1) / np.maximum((total > 0).sum(axis=-1), 1)


def global_average(counts: Counts) -> Counts:
    """Return the share of all objects that are found, from ``(..., 2 K)`` of ``class_counts``."""
    good, total = (half.sum(axis=-1) for half in np.split(counts, 2, axis=-1))
    return good / np.maximum(total, 1)


def f1(counts: Counts) -> Counts:
    """Return F1 from ``(..., 3)``: matches, predictions, annotated objects."""
    matched, predicted, true = np.moveaxis(counts, -1, 0)
    return 2 * matched / np.maximum(predicted + true, 1)


def bootstrap_interval(
    counts: Counts, statistic: Statistic, *, num_resamples: int = 2000, seed: int = 0
) -> Interval:
    """Return a number and the 95 % percentile interval of its values over scenes drawn with replacement.

    Args:
        counts: ``(S, C)``, what each scene adds to the sums that ``statistic`` is computed from.
        statistic: e.g. ``global_average``.
        num_resamples: how often to draw.
        seed: of the drawing; the same seed and scenes give the same interval.
    """
    return interval_of_scenes(_summed(counts, statistic), len(counts), num_resamples=num_resamples, seed=seed)


def interval_of_scenes(
    of_scenes: OfScenes, num_scenes: int, *, num_resamples: int = 2000, seed: int = 0
) -> Interval:
    """Do as ``bootstrap_interval`` does for a number that no sum over scenes tells.

    Args:
        of_scenes: the number of drawn scenes, indices in [0, S).
        num_scenes: S.
        num_resamples: how often to draw.
        seed: of the drawing.
    """
    value = float(of_scenes(np.arange(num_scenes)))
    low, high = _percentile_interval(of_scenes, num_scenes, value, num_resamples, seed)
    return Interval(value=value, low=low, high=high)


def compare_paired(
    first: Counts, second: Counts, statistic: Statistic, *, num_resamples: int = 2000, seed: int = 0
) -> Comparison:
    """Compare two results on the same scenes.

    Args:
        first: ``(S, C)``, as for ``bootstrap_interval``.
        second: ``(S, C)`` of the same scenes in the same order.
        statistic: e.g. ``global_average``.
        num_resamples: number of bootstrap draws, and of permutations; of few scenes all permutations count.
        seed: of both.

    Returns:
        The difference, its bootstrap interval (the same scenes drawn for both sides), and the p-value of the
        permutation test; ``significant`` if that is below 5 %.
    """
    rows = np.concatenate([first, second])
    return comparison_of_scenes(_summed(rows, statistic), len(first), num_resamples=num_resamples, seed=seed)


def comparison_of_scenes(
    of_rows: OfScenes, num_scenes: int, *, num_resamples: int = 2000, seed: int = 0
) -> Comparison:
    """Do as ``compare_paired`` does for a number that no sum over scenes tells.

    Args:
        of_rows: the number of drawn rows: row s is what the first side found in scene s, row S + s what the
            second did. A permutation swaps such rows.
        num_scenes: S.
        num_resamples: number of bootstrap draws, and of permutations.
        seed: of both.
    """

    def difference(of_first: NDArray[np.int64], of_second: NDArray[np.int64]) -> Counts:
        return of_rows(of_first) - of_rows(of_second)

    scenes = np.arange(num_scenes)
    observed = float(difference(scenes, scenes + num_scenes))
    low, high = _percentile_interval(
        lambda drawn: difference(drawn, drawn + num_scenes), num_scenes, observed, num_resamples, seed
    )
    p_value = 1.0  # of a single scene: swapping its sides leaves the difference as large as it was
    if num_scenes > 1:
        test = permutation_test(
            (scenes, scenes + num_scenes),
            lambda x, y, axis: np.abs(difference(np.moveaxis(x, axis, -1), np.moveaxis(y, axis, -1))),
            permutation_type="samples",
            vectorized=True,
            n_resamples=num_resamples,
            batch=_BATCH,
            alternative="greater",
            rng=np.random.default_rng(seed + 1),
        )
        p_value = float(test.pvalue)
    return Comparison(
        first=float(of_rows(scenes)),
        second=float(of_rows(scenes + num_scenes)),
        difference=observed,
        low=low,
        high=high,
        p_value=p_value,
        significant=p_value < 1 - CONFIDENCE,
        n_scenes=num_scenes,
    )


def _summed(counts: Counts, statistic: Statistic) -> OfScenes:
    """Return what a statistic says of the summed counts of drawn scenes."""
    return lambda drawn: statistic(counts[drawn].sum(axis=-2))


def _percentile_interval(
    of_scenes: OfScenes,
    num_scenes: int,
    value: float,
    num_resamples: int,
    seed: int,
) -> tuple[float, float]:
    """Return the bounds of a number's values over drawn scenes, ``value`` itself where none can be drawn.

    Args:
        of_scenes: from the numbers of drawn scenes ``(..., S)`` to the number, ``(...,)``.
        num_scenes: S.
        value: the number of all scenes.
        num_resamples: how often to draw.
        seed: of the drawing.
    """
    if num_scenes < 2:
        return value, value
    result = bootstrap(
        (np.arange(num_scenes),),
        lambda scenes, axis: of_scenes(np.moveaxis(scenes, axis, -1)),
        n_resamples=num_resamples,
        batch=_BATCH,
        vectorized=True,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)
