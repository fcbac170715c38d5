# SPDX-License-Identifier: Apache-2.0
"""Accuracy as a function of the thresholds (RayTran, "Transformation type ablation"), and by scene size."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.metrics.functional.alignment import SCAN2CAD_LIMITS, alignment_errors, row_blocks
from raytran.metrics.functional.detection import score_order
from raytran.metrics.per_scene import ObjectMetric, Row, SceneRecord
from raytran.structs import ObjectSet

FACTORS: tuple[float, ...] = tuple(round(0.1 * step, 1) for step in range(1, 31))
"""Multiples of ``SCAN2CAD_LIMITS`` at which the curves are sampled: 2 cm … 60 cm, 2° … 60°, 2 % … 60 %."""

SCENE_SIZES: tuple[int, ...] = (10, 20, 30)
"""Largest numbers of objects of the scenes that are also reported apart (RayTran §4)."""


class Curve(NamedTuple):
    """One curve: the limits that vary are multiples of ``SCAN2CAD_LIMITS``, the others are infinite."""

    name: str
    varies: tuple[bool, bool, bool]


CURVES: tuple[Curve, ...] = (
    Curve("translation", (True, False, False)),
    Curve("rotation", (False, True, False)),
    Curve("scale", (False, False, True)),
    Curve("joint", (True, True, True)),
)
"""Each threshold separately, the other two errors left out of account; then all three together."""


class CurveResult(TypedDict):
    """One curve; ``threshold`` in metres, degrees or as a ratio, for ``joint`` a multiple of all three."""

    threshold: list[float]
    class_average: list[float]
    global_average: list[float]


class AccuracyCurves(ObjectMetric):
    """Accuracy of protocol ``strict`` at many thresholds; the matching is made anew at each of them.

    Three curves vary one threshold and leave the other two errors out of account; the fourth scales the three
    limits of the benchmark together, so that at 1 it is ``Scan2CADAccuracy``.

    Args:
        **kwargs: see ``ObjectMetric``.
    """

    # An object: label, then whether it is found at each point of each curve.
    truth_columns = 1 + len(CURVES) * len(FACTORS)
    prediction_columns = 1

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._limits = np.array(_all_limits())

    def judge(self, predictions: ObjectSet, targets: ObjectSet) -> tuple[Tensor, Tensor]:
        """Match one scene at all thresholds; see the base class."""
        errors = torch.stack([*alignment_errors(predictions, targets)]).numpy()
        same_class = (predictions.label[:, None] == targets.label).numpy()
        free = np.ones((len(self._limits), len(targets)), dtype=bool)
        order = score_order(predictions.score).numpy()
        for part in row_blocks(len(order), free.size):
            within = (errors[:, order[part]] <= self._limits[:, :, None, None]).all(axis=1)
            _take_first_fit(same_class[order[part]] & within, free)
        truths = torch.cat([targets.label[:, None].double(), torch.from_numpy(~free.T).double()], dim=1)
        return truths, predictions.label[:, None].double()

    def compute(self) -> dict[str, CurveResult]:
        """Return each curve by name."""
        truths = self.truths()
        one_hot = torch.nn.functional.one_hot(truths[:, 0].long(), len(self.classes)).double()
        total = one_hot.sum(dim=0)
        good = truths[:, 1:].T @ one_hot
        by_class = (good / total.clamp(min=1))[:, total > 0]
        class_average = by_class.sum(dim=1) / max(by_class.shape[1], 1)
        global_average = good.sum(dim=1) / total.sum().clamp(min=1)
        curves: dict[str, CurveResult] = {}
        for index, curve in enumerate(CURVES):
            points = slice(index * len(FACTORS), (index + 1) * len(FACTORS))
            unit = 1.0 if curve.name == "joint" else SCAN2CAD_LIMITS[index]
            curves[curve.name] = CurveResult(
                threshold=[_scaled(unit, factor) for factor in FACTORS],
                class_average=class_average[points].tolist(),
                global_average=global_average[points].tolist(),
            )
        return curves

    def object_rows(self, record: SceneRecord) -> list[Row]:
        """Return for each object the least multiple of the three limits at which it is found, or None."""
        joint = record.truths[:, -len(FACTORS) :] == 1
        rows: list[Row] = []
        for index, (label, found) in enumerate(zip(record.truths[:, 0].tolist(), joint, strict=True)):
            first = FACTORS[int(found.long().argmax())] if found.any() else None
            row: Row = {
                "scene_id": record.scene_id,
                "object": index,
                "category": self.classes.names[int(label)],
            }
            rows.append(row | {"found_from": first})
        return rows

    def scene_row(self, record: SceneRecord) -> Row:
        """Return the number of objects of one scene."""
        return {"scene_id": record.scene_id, "n_total": len(record.truths)}


def accuracy_by_scene_size(rows: Iterable[Row], sizes: Sequence[int] = SCENE_SIZES) -> dict[str, Any]:
    """Return the accuracy on the scenes with at most so many annotated objects.

    Args:
        rows: a row for each object with ``scene_id``, ``category`` and ``matched``, as from
            ``Scan2CADAccuracy.rows("object")``; a scene without objects changes nothing.
        sizes: the largest numbers of objects.

    Returns:
        by size: ``class_average``, ``global_average``, ``n_good``, ``n_total``, ``n_scenes``.
    """
    table = list(rows)
    size_of = Counter(row["scene_id"] for row in table)
    result: dict[str, Any] = {}
    for size in sizes:
        in_small = [row for row in table if size_of[row["scene_id"]] <= size]
        total = Counter(row["category"] for row in in_small)
        good = Counter(row["category"] for row in in_small if row["matched"])
        result[str(size)] = {
            "class_average": sum(good[name] / count for name, count in total.items()) / max(len(total), 1),
            "global_average": good.total() / max(len(in_small), 1),
            "n_good": good.total(),
            "n_total": len(in_small),
            "n_scenes": sum(count <= size for count in size_of.values()),
        }
    return result


def _all_limits() -> list[tuple[float, ...]]:
    return [
        tuple(
            _scaled(limit, factor) if varies else np.inf
            for limit, varies in zip(SCAN2CAD_LIMITS, curve.varies, strict=True)
        )
        for curve in CURVES
        for factor in FACTORS
    ]


def _scaled(limit: float, factor: float) -> float:
    """Return the product as a user would write it: 0.2 · 3 is 0.6, not 0.6000000000000001."""
    return float(f"{limit * factor:.12g}")


def _take_first_fit(allowed: NDArray[np.bool_], free: NDArray[np.bool_]) -> None:
    """Give each prediction, one after another, the first free object it may take; at all thresholds at once.

    Args:
        allowed: ``(T, P, M)``, whether a prediction may take an object at a threshold, in the order in which
            they choose.
        free: ``(T, M)``, whether an object is free; set to False where it is taken.
    """
    every = np.arange(len(free))
    for index in range(allowed.shape[1]):
        fits = allowed[:, index] & free
        if fits.any():
            first = fits.argmax(axis=1)
            free[every, first] &= ~fits[every, first]
