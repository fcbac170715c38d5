# SPDX-License-Identifier: Apache-2.0
"""Scan2CAD accuracy: the share of annotated objects that are found with the right class and pose."""

from __future__ import annotations

from typing import Any, TypedDict

import torch
from torch import Tensor

from raytran.errors import ConfigError
from raytran.metrics.functional.alignment import alignment_errors
from raytran.metrics.functional.matching import match_in_order, score_order
from raytran.metrics.records import Row, SceneRecord, SceneRecordMetric
from raytran.types import CLASSES, ObjectSet

SCAN2CAD_PROTOCOLS: tuple[str, ...] = ("strict",)


class ClassAccuracy(TypedDict):
    """Accuracy on the objects of one class; 0 if there are none."""

    n_good: int
    n_total: int
    accuracy: float


class Scan2CADResult(TypedDict):
    """What ``Scan2CADAccuracy.compute`` returns."""

    per_class: dict[str, ClassAccuracy]
    class_average: float
    global_average: float
    n_good: int
    n_total: int
    n_scenes: int


class Scan2CADAccuracy(SceneRecordMetric):
    """Share of annotated objects that a prediction finds within 20 cm, 20 degrees and 20 % of size together.

    It is a recall: predictions too many cost nothing. Protocol ``strict``:

    - every scene counts, also one without predictions; all nine classes, matched by name;
    - predictions take their turn by score, and each takes the first annotated object still free that it fits;
    - translation is the distance of the box centres; size error is ``|mean(size / true size) - 1|``;
    - rotation is the full angle, the least over the annotated object's symmetry;
    - no cap on the number of predictions and no removal of duplicates.

    Args:
        protocol: ``"strict"``.
        max_translation: metres, inclusive.
        max_rotation: degrees, inclusive.
        max_scale: ratio, inclusive.
        **kwargs: see ``torchmetrics.Metric``.

    Raises:
        ConfigError: the protocol is unknown.
    """

    # An object: label, whether it is found, then errors and score of the prediction that took it, else of the
    # nearest of its class (NaN if none). A prediction: label, score, whether it took an object.
    truth_columns = 6
    prediction_columns = 3

    def __init__(
        self,
        *,
        protocol: str = "strict",
        max_translation: float = 0.2,
        max_rotation: float = 20.0,
        max_scale: float = 0.2,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if protocol not in SCAN2CAD_PROTOCOLS:
            known = ", ".join(SCAN2CAD_PROTOCOLS)
            raise ConfigError(f"unknown protocol {protocol!r} of Scan2CADAccuracy, choose one of: {known}")
        self.protocol = protocol
        self.limits = (max_translation, max_rotation, max_scale)

    def judge(self, predictions: ObjectSet, targets: ObjectSet) -> tuple[Tensor, Tensor]:
        """Match one scene; see the base class."""
        errors = alignment_errors(predictions, targets)
        same_class = predictions.label[:, None] == targets.label
        match = match_in_order(score_order(predictions.score), same_class & errors.within(*self.limits))

        taken_by = torch.full((len(targets),), -1)
        taker = (match >= 0).nonzero().squeeze(1)
        taken_by[match[taker]] = taker
        values = torch.stack([*errors, predictions.score[:, None].expand_as(same_class)], dim=-1)
        values = torch.cat([values, values.new_full((1, len(targets), 4), torch.nan)])
        shown = torch.where(taken_by >= 0, taken_by, _nearest(errors.translation, same_class))
        truths = torch.stack([targets.label, taken_by >= 0], dim=-1).double()
        truths = torch.cat([truths, values[shown, torch.arange(len(targets))]], dim=-1)
        return truths, torch.stack(
            [predictions.label.double(), predictions.score, (match >= 0).double()], dim=-1
        )

    def compute(self) -> Scan2CADResult:
        """Return the accuracy of each class, the mean over those that occur, and that of all objects."""
        scenes = self.scenes()
        truths = torch.cat([torch.zeros(0, self.truth_columns), *(scene.truths for scene in scenes)])
        label, found = truths[:, 0].long(), truths[:, 1] == 1
        total = torch.bincount(label, minlength=len(CLASSES)).tolist()
        good = torch.bincount(label[found], minlength=len(CLASSES)).tolist()
        per_class = {
            name: ClassAccuracy(n_good=n_good, n_total=n_total, accuracy=n_good / max(n_total, 1))
            for name, n_good, n_total in zip(CLASSES, good, total, strict=True)
        }
        present = [entry["accuracy"] for entry in per_class.values() if entry["n_total"]]
        return Scan2CADResult(
            per_class=per_class,
            class_average=sum(present) / max(len(present), 1),
            global_average=sum(good) / max(sum(total), 1),
            n_good=sum(good),
            n_total=sum(total),
            n_scenes=len(scenes),
        )

    def object_rows(self, record: SceneRecord) -> list[Row]:
        """Return whether each object is found, and the errors of its prediction or else of the nearest."""
        rows: list[Row] = []
        for index, (label, found, *values) in enumerate(record.truths.tolist()):
            translation, rotation, scale, score = (None if value != value else value for value in values)
            row: Row = {"scene_id": record.scene_id, "object": index, "category": CLASSES[int(label)]}
            row |= {
                "matched": bool(found),
                "translation_error_m": translation,
                "rotation_error_deg": rotation,
            }
            row |= {"scale_error": scale, "score": score}
            rows.append(row)
        return rows

    def scene_row(self, record: SceneRecord) -> Row:
        """Return the counts of one scene."""
        n_good, n_total = int(record.truths[:, 1].sum()), len(record.truths)
        counts: Row = {"n_good": n_good, "n_total": n_total, "n_predicted": len(record.predictions)}
        return {"scene_id": record.scene_id, **counts, "accuracy": n_good / max(n_total, 1)}


def _nearest(distance: Tensor, same_class: Tensor) -> Tensor:
    """Return for each object the nearest prediction of its class, ``(P, M)`` → ``(M,)``, or -1."""
    if distance.shape[0] == 0:
        return torch.full((distance.shape[1],), -1)
    nearest = torch.where(same_class, distance.nan_to_num(nan=torch.inf), torch.inf).argmin(dim=0)
    return torch.where(same_class.any(dim=0), nearest, -1)
