# SPDX-License-Identifier: Apache-2.0
"""Error atlas: why each annotated object is missed, and what became of each prediction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypedDict

import torch
from torch import Tensor

from raytran.metrics.functional.alignment import SCAN2CAD_LIMITS, alignment_errors
from raytran.metrics.functional.detection import match_in_order, score_order
from raytran.metrics.per_scene import ObjectMetric, Row, SceneRecord
from raytran.structs import ObjectSet

CAUSES: tuple[str, ...] = (
    "found",
    "outside the volume",
    "duplicate",
    "translation",
    "rotation",
    "scale",
    "wrong class",
    "missed",
)
"""What can be said of an annotated object; all but the first are misses, the first that holds is taken."""

FATES: tuple[str, ...] = ("match", "duplicate", "misaligned", "wrong class", "background")
"""What can be said of a prediction."""


class AtlasResult(TypedDict):
    """Counts of ``CAUSES`` in all and by class, and of ``FATES``."""

    objects: dict[str, int]
    per_class: dict[str, dict[str, int]]
    predictions: dict[str, int]
    n_missed: int


class ErrorAtlas(ObjectMetric):
    """Sorts every object that protocol ``strict`` counts as missed by its cause.

    A prediction is *near* an object if its centre lies within half the diagonal of the object's box, and at
    least within the translation limit. An object that no prediction found is, in this order,

    - ``outside the volume``: its box centre lies outside the voxel grid, where that is known;
    - ``duplicate``: a prediction fits it, but found another object, and a prediction counts once;
    - ``translation``, ``rotation`` or ``scale``: a free prediction of its class is near; the one that exceeds
      its worst limit least is taken, and the limit it exceeds most, as a multiple, is the cause;
    - ``wrong class``: a free prediction of another class is near;
    - ``missed``: none of these.

    A prediction that found nothing is a ``duplicate`` if it fits an object found by another, ``misaligned``
    if it is near an object of its class, ``wrong class`` if near one of another class, else ``background``.

    Args:
        volume_extent: size of the voxel grid in metres, for ``outside the volume``.
        **kwargs: see ``ObjectMetric``.
    """

    # An object: label, index into CAUSES. A prediction: label, index into FATES.
    truth_columns = 2
    prediction_columns = 2

    def __init__(self, *, volume_extent: Sequence[float] | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._half_extent = None if volume_extent is None else torch.tensor(list(volume_extent)).double() / 2
        self._center: Tensor | None = None

    def update(
        self,
        predictions: Sequence[ObjectSet],
        targets: Sequence[ObjectSet],
        scene_ids: Sequence[str],
        volume_centers: Sequence[Tensor | None] | None = None,
    ) -> None:
        """Judge scenes; see the base class.

        Args:
            predictions: the predicted objects of each scene.
            targets: the annotated objects of each scene.
            scene_ids: the name of each scene.
            volume_centers: ``(3,)`` centre of each scene's voxel grid, metres, or None where it is unknown.
        """
        centers = volume_centers or [None] * len(scene_ids)
        for predicted, target, name, center in zip(predictions, targets, scene_ids, centers, strict=True):
            self._center = center
            super().update([predicted], [target], [name])

    def judge(self, predictions: ObjectSet, targets: ObjectSet) -> tuple[Tensor, Tensor]:
        """Sort the objects and predictions of one scene; see the base class."""
        errors = alignment_errors(predictions, targets)
        same_class = predictions.label[:, None] == targets.label
        fits = same_class & errors.within(*SCAN2CAD_LIMITS)
        match = match_in_order(score_order(predictions.score), fits)
        free = match < 0
        is_found = torch.zeros(len(targets), dtype=torch.bool).index_fill(0, match[~free], True)
        reach = (targets.size.norm(dim=-1) / 2).clamp(min=SCAN2CAD_LIMITS[0])
        near = errors.translation <= reach

        # Causes are set from the last to the first, so that the first that holds stays.
        excess = torch.stack([error / limit for error, limit in zip(errors, SCAN2CAD_LIMITS, strict=True)])
        worst, which = excess.max(dim=0)
        cause = torch.full((len(targets),), CAUSES.index("missed"))
        cause[(near & ~same_class & free[:, None]).any(dim=0)] = CAUSES.index("wrong class")
        candidates = near & same_class & free[:, None]
        if len(predictions):
            choice = torch.where(candidates, worst, torch.inf).argmin(dim=0)
            limit = which[choice, torch.arange(len(targets))] + CAUSES.index("translation")
            cause = torch.where(candidates.any(dim=0), limit, cause)
        cause[fits.any(dim=0)] = CAUSES.index("duplicate")
        cause[self._outside(targets.center)] = CAUSES.index("outside the volume")
        cause[is_found] = CAUSES.index("found")

        fate = torch.full((len(predictions),), FATES.index("background"))
        fate[near.any(dim=1)] = FATES.index("wrong class")
        fate[(near & same_class).any(dim=1)] = FATES.index("misaligned")
        fate[fits.any(dim=1)] = FATES.index("duplicate")
        fate[~free] = FATES.index("match")
        return (
            torch.stack([targets.label, cause], dim=-1).double(),
            torch.stack([predictions.label, fate], dim=-1).double(),
        )

    def _outside(self, center: Tensor) -> Tensor:
        if self._half_extent is None or self._center is None:
            return torch.zeros(len(center), dtype=torch.bool)
        return ((center - self._center.detach().cpu().double()).abs() > self._half_extent).any(dim=-1)

    def compute(self) -> AtlasResult:
        """Return the counts over all scenes."""
        truths, fates = self.truths().long(), self.predictions().long()
        per_class = {
            name: _count(truths[truths[:, 0] == label, 1], CAUSES)
            for label, name in enumerate(self.classes.names)
        }
        objects = _count(truths[:, 1], CAUSES)
        return AtlasResult(
            objects=objects,
            per_class=per_class,
            predictions=_count(fates[:, 1], FATES),
            n_missed=len(truths) - objects["found"],
        )

    def object_rows(self, record: SceneRecord) -> list[Row]:
        """Return the cause for each object."""
        return [
            {
                "scene_id": record.scene_id,
                "object": index,
                "category": self.classes.names[int(label)],
                "cause": CAUSES[int(cause)],
            }
            for index, (label, cause) in enumerate(record.truths.tolist())
        ]

    def scene_row(self, record: SceneRecord) -> Row:
        """Return how often each cause occurs in one scene."""
        return {"scene_id": record.scene_id, **_count(record.truths[:, 1].long(), CAUSES)}


def _count(index: Tensor, names: Sequence[str]) -> dict[str, int]:
    return dict(zip(names, torch.bincount(index, minlength=len(names)).tolist(), strict=True))
