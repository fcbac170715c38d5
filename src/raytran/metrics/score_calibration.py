# SPDX-License-Identifier: Apache-2.0
"""Calibration: whether of the boxes with a score of 0.9 nine in ten are right."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from raytran.errors import ConfigError
from raytran.metrics.functional.calibration import NUM_BINS, Reliability, fit_scaling, reliability
from raytran.metrics.functional.detection import iou_within_class, match_in_order, score_order
from raytran.metrics.per_scene import ObjectMetric, Row, SceneRecord
from raytran.structs import ObjectSet


class CalibrationResult(Reliability):
    """What ``ScoreCalibration.compute`` returns.

    Attributes:
        scaling: ``scale`` and ``offset`` under which these scores would fit best (``ScoreScaling``); None
            where the predictions do not tell.
    """

    scaling: dict[str, float] | None


class ScoreCalibration(ObjectMetric):
    """Expected calibration error of the scores against *the box is right*.

    A box is right if it takes a true object of its class in the matching of ``OrientedBoxF1`` with protocol
    ``strict``: in the order of the scores, one to one, with an IoU above the threshold. All predictions given
    count, so the result is that of the scores at hand: those of every query, most of them low and rightly
    so, or those of what is shown.

    Args:
        iou_threshold: IoU that a match must exceed.
        num_bins: intervals of scores, equally wide.
        **kwargs: see ``ObjectMetric``.

    Raises:
        ConfigError: there is no bin.
    """

    higher_is_better = False
    truth_columns = 2  # label, whether it is matched
    prediction_columns = 3  # label, score, whether it is right

    def __init__(self, *, iou_threshold: float = 0.25, num_bins: int = NUM_BINS, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if num_bins < 1:
            raise ConfigError(f"{num_bins} bins of scores are too few: give at least 1")
        self.iou_threshold, self.num_bins = iou_threshold, num_bins

    def judge(self, predictions: ObjectSet, targets: ObjectSet) -> tuple[Tensor, Tensor]:
        """Match one scene; see the base class."""
        iou = iou_within_class(predictions, targets)
        match = match_in_order(score_order(predictions.score), iou > self.iou_threshold, preference=iou)
        found = torch.zeros(len(targets)).double().index_fill(0, match[match >= 0], 1.0)
        right = torch.stack([predictions.label.double(), predictions.score, (match >= 0).double()], dim=-1)
        return torch.stack([targets.label.double(), found], dim=-1), right

    def compute(self) -> CalibrationResult:
        """Return the error, its bins, and the scaling that would mend it."""
        _, score, right = self.predictions().unbind(dim=-1)
        scaling = fit_scaling(score, right > 0)
        return CalibrationResult(
            **reliability(score, right > 0, num_bins=self.num_bins),
            scaling=None if scaling is None else scaling.settings(),
        )

    def object_rows(self, record: SceneRecord) -> list[Row]:
        """Return whether each object is taken by a prediction."""
        return [
            {
                "scene_id": record.scene_id,
                "object": index,
                "category": self.classes.names[int(label)],
                "found": bool(found),
            }
            for index, (label, found) in enumerate(record.truths.tolist())
        ]

    def scene_row(self, record: SceneRecord) -> Row:
        """Return the counts of one scene."""
        n_right = int(record.predictions[:, 2].sum())
        return {"scene_id": record.scene_id, "n_predicted": len(record.predictions), "n_right": n_right}
