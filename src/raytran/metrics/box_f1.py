# SPDX-License-Identifier: Apache-2.0
"""Precision, recall and F1 of oriented boxes, the metric introduced by ODAM (Li et al., 2021)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import torch
from torch import Tensor

from raytran.classes import PAPER_CLASSES
from raytran.errors import ConfigError
from raytran.metrics.functional.cad_errors import cad_half_extents
from raytran.metrics.functional.detection import (
    BestScores,
    DetectionScores,
    average_precision,
    best_f1,
    detection_scores,
    iou_within_class,
    match_in_order,
    score_order,
)
from raytran.metrics.functional.odam import bev_iou, odam_predicted_boxes, odam_true_boxes
from raytran.metrics.per_scene import ProtocolMetric, Row, SceneRecord
from raytran.structs import CadAlignments, ObjectSet

BOX_F1_PROTOCOLS: tuple[str, ...] = ("strict", "odam")


class ThresholdScores(DetectionScores):
    """Scores of all predictions at one IoU threshold, and of those above the score that maximises F1.

    ``average_precision`` pools all classes, as F1 does; ``mean_average_precision`` is the mean over the
    classes of the true objects. ``per_class`` has the classes of the true objects and of the predictions.
    """

    per_class: dict[str, DetectionScores]
    best: BestScores
    average_precision: float
    mean_average_precision: float


class BoxF1Result(TypedDict):
    """What ``OrientedBoxF1.compute`` returns; the keys of ``per_threshold`` are IoUs, such as ``"0.25"``."""

    per_threshold: dict[str, ThresholdScores]
    n_scenes: int


class OrientedBoxF1(ProtocolMetric):
    """Precision, recall and F1 of predicted boxes, pooled over all classes and scenes.

    Protocol ``strict``, which compares ``ObjectSet``s: exact IoU of the oriented boxes; all classes,
    matched by name; predictions choose in the order of their scores, and each takes the free object of
    highest IoU if that is *above* the threshold, so that matching is one to one; every scene counts. All
    predictions given count; ``best`` tells what is reached when those below one score, chosen to maximise F1,
    are left out.

    Protocol ``odam`` gives the counts of ODAM's script and compares ``CadAlignments``: boxes on the CAD's
    origin and their overlap seen from above times that of the heights (``functional.odam``); the eight
    classes with a name; a prediction takes all objects of its class that are still free and whose IoU is
    above the threshold, and counts as matched once for each; a scene whose predictions are None is left out,
    one with no predictions counts.

    Args:
        protocol: ``"strict"`` or ``"odam"``.
        cad_half_extents: of each ``catid/id``, for ``odam``, the boxes of predictions that do not bring their
            own (``functional.cad_errors.cad_half_extents``). None: those of each scene's own annotation.
        iou_thresholds: IoUs that a match must exceed.
        **kwargs: see ``ObjectMetric``.

    Raises:
        ConfigError: the protocol is unknown, or there is no threshold.
    """

    def __init__(
        self,
        *,
        protocol: str = "strict",
        cad_half_extents: Mapping[str, Sequence[float]] | None = None,
        iou_thresholds: Sequence[float] = (0.25, 0.5),
        **kwargs: Any,
    ) -> None:
        if protocol not in BOX_F1_PROTOCOLS:
            known = ", ".join(BOX_F1_PROTOCOLS)
            raise ConfigError(f"unknown protocol {protocol!r} of OrientedBoxF1, choose one of: {known}")
        if not iou_thresholds:
            raise ConfigError("OrientedBoxF1 needs at least one IoU threshold, e.g. [0.25, 0.5]")
        super().__init__(protocol=protocol, **kwargs)
        self.drops_missing = protocol == "odam"
        self.cad_half_extents = None if cad_half_extents is None else dict(cad_half_extents)
        self.iou_thresholds = tuple(iou_thresholds)
        # Label; of an object the highest IoU with a prediction of its class, of a prediction the score; then
        # whether it is matched, or how often, at each threshold. An object with label -1 does not count.
        self.truth_columns = self.prediction_columns = 2 + len(self.iou_thresholds)

    def judge_cads(self, predictions: CadAlignments, targets: CadAlignments) -> tuple[Tensor, Tensor]:
        """Match by CAD alignments."""
        half_extents = cad_half_extents([targets]) if self.cad_half_extents is None else self.cad_half_extents
        predicted_corners, predictions = odam_predicted_boxes(predictions, half_extents)
        true_corners, counted = odam_true_boxes(targets)
        label, true_label = _labels(predictions), _labels(targets)[counted]
        iou = bev_iou(predicted_corners, true_corners)
        iou = torch.where(label[:, None] == true_label, iou, 0.0)
        order = score_order(predictions.score)
        taken = [label.double(), predictions.score]
        truths = [true_label.double(), torch.cat([iou, iou.new_zeros(1, len(true_label))]).amax(dim=0)]
        for threshold in self.iou_thresholds:
            above = (iou > threshold)[order]
            first = above & (above.cumsum(dim=0) == 1)  # each object goes to the first that overlaps it
            taken.append(torch.zeros(len(label)).double().index_copy(0, order, first.sum(dim=1).double()))
            truths.append(first.any(dim=0).double())
        every = torch.full((len(targets), self.truth_columns), -1.0, dtype=torch.float64)
        every[counted] = torch.stack(truths, dim=-1)
        return every, torch.stack(taken, dim=-1)

    def judge_objects(self, predictions: ObjectSet, targets: ObjectSet) -> tuple[Tensor, Tensor]:
        """Match by boxes."""
        iou = iou_within_class(predictions, targets)
        order = score_order(predictions.score)
        best = torch.cat([iou, iou.new_zeros(1, len(targets))]).amax(dim=0)
        truths = [targets.label.double(), best]
        taken = [predictions.label.double(), predictions.score.nan_to_num(nan=-torch.inf)]
        for threshold in self.iou_thresholds:
            match = match_in_order(order, iou > threshold, preference=iou)
            taken.append((match >= 0).double())
            truths.append(torch.zeros(len(targets)).double().index_fill(0, match[match >= 0], 1.0))
        return torch.stack(truths, dim=-1), torch.stack(taken, dim=-1)

    def compute(self) -> BoxF1Result:
        """Return precision, recall, F1 and counts at each IoU threshold."""
        predictions, truths = self.predictions(), _counted(self.truths())
        per_threshold = {
            f"{threshold:g}": self._scores_at(column, predictions, truths[:, 0])
            for column, threshold in enumerate(self.iou_thresholds, start=2)
        }
        return BoxF1Result(per_threshold=per_threshold, n_scenes=len(self.scenes()))

    def _scores_at(self, column: int, predictions: Tensor, true_label: Tensor) -> ThresholdScores:
        """Return the scores of one threshold, whose matches are in ``column`` of ``predictions``."""
        label, score, matched = predictions[:, 0], predictions[:, 1], predictions[:, column].long()
        n_true = len(true_label)
        by_class = [
            average_precision(score[label == k], matched[label == k], int((true_label == k).sum()))
            for k in true_label.unique()
        ]
        per_class = {
            self.classes.names[int(k)]: detection_scores(
                int(matched[label == k].sum()), int((label == k).sum()), int((true_label == k).sum())
            )
            for k in torch.cat([true_label, label]).unique()
        }
        return ThresholdScores(
            per_class=per_class,
            **detection_scores(int(matched.sum()), len(predictions), n_true),
            best=best_f1(score, matched, n_true),
            average_precision=average_precision(score, matched, n_true),
            mean_average_precision=sum(by_class) / max(len(by_class), 1),
        )

    def object_rows(self, record: SceneRecord) -> list[Row]:
        """Return each object's highest IoU with a prediction of its class, and whether it is matched."""
        rows: list[Row] = []
        for index, (label, best, *matched) in enumerate(record.truths.tolist()):
            if label < 0:
                continue
            row: Row = {
                "scene_id": record.scene_id,
                "object": index,
                "category": self.classes.names[int(label)],
            }
            rows.append(
                row | {"best_iou": best} | self._by_threshold("matched", [bool(value) for value in matched])
            )
        return rows

    def scene_row(self, record: SceneRecord) -> Row:
        """Return the counts of one scene."""
        truths = _counted(record.truths)
        counts: Row = {"n_predicted": len(record.predictions), "n_true": len(truths)}
        matched = truths[:, 2:].sum(dim=0).long().tolist()
        return {"scene_id": record.scene_id, **counts, **self._by_threshold("n_matched", matched)}

    def _by_threshold(self, name: str, values: Sequence[int]) -> Row:
        return {
            f"{name}_{threshold:g}": value
            for threshold, value in zip(self.iou_thresholds, values, strict=True)
        }


def _counted(truths: Tensor) -> Tensor:
    """Return the rows of the objects that count."""
    return truths[truths[:, 0] >= 0]


def _labels(alignments: CadAlignments) -> Tensor:
    return torch.tensor([PAPER_CLASSES.index(name) for name in alignments.category], dtype=torch.int64)
