# SPDX-License-Identifier: Apache-2.0
"""Mean average precision of boxes as detectors of indoor objects report it, for ScanNet and ARKitScenes.

The conventions are those of VoteNet's ``eval_det`` (Qi et al., 2019), which mmdetection3d's ``indoor_eval``
took over and with it ImVoxelNet, NeRF-Det, SGCDet and VGGT-Det:

- The detections of a class in all scenes are ordered by descending score. Each looks at the one true object
  of its scene and class with the highest IoU, the first of equals. It is right if that IoU is *above* the
  threshold and no detection before it was right about the same object; else it is wrong. It never falls back
  on its second best object, where ``OrientedBoxF1`` does.
- Precision and recall are counted detection by detection; average precision is the area under the highest
  precision at each recall or beyond (PASCAL VOC from 2010 on); the mean goes over the classes that occur in
  the truth. A class without detections counts with 0. Detections of a class that is not in the truth are left
  out; the scripts make the mean not-a-number for them.
- Detections of equal score: the scripts sort with ``numpy.argsort``, which keeps no order among equals, with
  AVX-512 from four detections on. Here equals come by the names of their scenes, and within a scene in the
  order given: what a stable sort makes of scenes in the order of their names, on any number of ranks.
- A box without volume has IoU 0 with every box; a true one counts as an object that nobody finds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.errors import ConfigError
from raytran.geometry.boxes import OrientedBoxes, axis_aligned_iou, box_iou
from raytran.metrics.bootstrap import Counts, OfScenes
from raytran.metrics.functional.detection import score_order
from raytran.metrics.per_scene import ObjectMetric, Row, SceneRecord
from raytran.structs import ObjectSet

BOX_FORMS: tuple[str, ...] = ("oriented", "axis_aligned")

IOU_THRESHOLDS: tuple[float, ...] = (0.25, 0.5)

_LABEL, _SCORE = 0, 1
_MATCHED = 2
"""Columns of a record's predictions; the third is of the first threshold, and one follows for each other."""


class ThresholdPrecision(TypedDict):
    """What detectors report at one IoU threshold, by class and as the mean over the classes of the truth.

    ``mean`` and ``per_class`` are of the average precision; recall is that of all detections (mAR).
    """

    mean: float
    per_class: dict[str, float]
    mean_recall: float
    recall_per_class: dict[str, float]


class MeanAveragePrecision(ObjectMetric):
    """Mean average precision (mAP) of ``ObjectSet``s, see the head of this file.

    ``compute`` returns for each threshold ``iou_0.25`` and so on a ``ThresholdPrecision``, and ``n_true``
    and ``n_predicted`` by class, ``n_scenes`` and ``boxes``. All predictions given count: leave none out
    because of a low score.

    Args:
        boxes: ``"oriented"`` compares the boxes as they are, by their exact IoU; ``"axis_aligned"`` the boxes
            along the world's axes around them, as the labels of ScanNet are boxes around instances.
        iou_thresholds: IoUs that a detection must exceed.
        **kwargs: see ``ObjectMetric``.

    Raises:
        ConfigError: there is no such form of boxes, no threshold, or one that is no share.
    """

    def __init__(
        self,
        *,
        boxes: str = "oriented",
        iou_thresholds: Sequence[float] = IOU_THRESHOLDS,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if boxes not in BOX_FORMS:
            raise ConfigError(f"unknown boxes={boxes}, choose one of: {', '.join(BOX_FORMS)}")
        if not iou_thresholds or not all(0 <= threshold < 1 for threshold in iou_thresholds):
            raise ConfigError(
                f"IoU thresholds must be shares below 1, e.g. [0.25, 0.5], got {list(iou_thresholds)}"
            )
        self.boxes = boxes
        self.iou_thresholds = tuple(iou_thresholds)
        # Label; of an object the highest IoU with a detection of its class, of a detection the score; then
        # whether it is found or right, at each threshold.
        self.truth_columns = self.prediction_columns = 2 + len(self.iou_thresholds)

    def judge(self, predictions: ObjectSet, targets: ObjectSet) -> tuple[Tensor, Tensor]:
        """Match one scene; see the base class."""
        found, true = (
            OrientedBoxes(side.center, side.size, side.rotation) for side in (predictions, targets)
        )
        iou = box_iou(found, true)[0] if self.boxes == "oriented" else axis_aligned_iou(found, true)
        same_class = predictions.label[:, None] == targets.label
        order = score_order(predictions.score)
        truths = [targets.label.double(), _best(torch.where(same_class, iou, 0.0))]
        detections = [predictions.label.double(), predictions.score.nan_to_num(nan=-torch.inf)]
        for threshold in self.iou_thresholds:
            taken = match_to_best(iou, same_class, order, threshold)
            detections.append((taken >= 0).double())
            truths.append(torch.zeros(len(targets)).double().index_fill(0, taken[taken >= 0], 1.0))
        return torch.stack(truths, dim=-1), torch.stack(detections, dim=-1)

    def scenes_by_name(self) -> list[SceneRecord]:
        """Return the records of ``scenes`` in the order of their names, the same on any number of ranks."""
        return sorted(self.scenes(), key=lambda record: record.scene_id)

    def compute(self) -> dict[str, Any]:
        """Return average precision and recall at each threshold, by class and in the mean, and counts."""
        records = self.scenes_by_name()
        rankings = class_rankings(records, self.classes.names)
        every = np.arange(len(records))
        result: dict[str, Any] = {
            "boxes": self.boxes,
            "n_scenes": len(records),
            "n_true": {name: int(ranking.n_true.sum()) for name, ranking in rankings.items()},
            "n_predicted": {name: len(ranking.scene) for name, ranking in rankings.items()},
        }
        for column, threshold in enumerate(self.iou_thresholds):
            precision = {
                name: float(average_precision_of_draws(ranking, column, every))
                for name, ranking in rankings.items()
            }
            recall = {
                name: float(ranking.matched[:, column].sum() / ranking.n_true.sum())
                for name, ranking in rankings.items()
            }
            result[threshold_name(threshold)] = ThresholdPrecision(
                mean=_mean(precision), per_class=precision, mean_recall=_mean(recall), recall_per_class=recall
            )
        return result

    def object_rows(self, record: SceneRecord) -> list[Row]:
        """Return each object's highest IoU with a detection of its class, and whether it is found."""
        rows: list[Row] = []
        for index, (label, best, *found) in enumerate(record.truths.tolist()):
            row: Row = {"scene_id": record.scene_id, "object": index}
            row |= {"category": self.classes.names[int(label)], "best_iou": best}
            rows.append(row | self._by_threshold("matched", [bool(value) for value in found]))
        return rows

    def scene_row(self, record: SceneRecord) -> Row:
        """Return the counts of one scene."""
        counts: Row = {"n_predicted": len(record.predictions), "n_true": len(record.truths)}
        matched = record.truths[:, _MATCHED:].sum(dim=0).long().tolist()
        return {"scene_id": record.scene_id, **counts, **self._by_threshold("n_matched", matched)}

    def _by_threshold(self, name: str, values: Sequence[int]) -> Row:
        return {
            f"{name}_{threshold:g}": value
            for threshold, value in zip(self.iou_thresholds, values, strict=True)
        }


def threshold_name(threshold: float) -> str:
    """Return what results at an IoU threshold stand under, e.g. ``iou_0.25``."""
    return f"iou_{threshold:g}"


def match_to_best(iou: Tensor, same_class: Tensor, order: Tensor, threshold: float) -> Tensor:
    """Give each detection the true object that it overlaps most, if it is the first to want it.

    Args:
        iou: ``(P, M)`` of detections and true objects.
        same_class: ``(P, M)`` bool; other pairs do not count.
        order: ``(P,)`` int64, the detections in the order of their scores.
        threshold: IoU that a detection must exceed.

    Returns:
        ``(P,)`` int64, the object of each detection that is right, -1 for those that are wrong.
    """
    n_detected, n_true = iou.shape
    if n_true == 0:
        return torch.full((n_detected,), -1)
    overlap, choice = torch.where(same_class, iou, -1.0)[order].max(dim=1)  # the first of equals
    above = overlap > threshold
    place = torch.arange(n_detected)
    first = torch.full((n_true,), n_detected).scatter_reduce(0, choice[above], place[above], "amin")
    is_right = above & (first[choice] == place)
    return torch.empty(n_detected, dtype=torch.int64).index_copy(0, order, torch.where(is_right, choice, -1))


@dataclass(frozen=True)
class ClassRanking:
    """The detections of one class in ``S`` scenes, surest first.

    Attributes:
        scene: ``(P,)`` int64 in [0, S).
        matched: ``(P, T)`` bool, whether each is right, at each threshold.
        n_true: ``(S,)`` how many true objects of the class each scene has.
    """

    scene: NDArray[np.int64]
    matched: NDArray[np.bool_]
    n_true: NDArray[np.int64]


def class_rankings(records: Sequence[SceneRecord], class_names: Sequence[str]) -> dict[str, ClassRanking]:
    """Rank the detections of the classes that occur in the truth, by name.

    Args:
        records: of scenes, as ``MeanAveragePrecision`` makes them; equal scores come in their order.
        class_names: of the labels.
    """
    if not records:
        return {}
    true_label, detections = (
        torch.cat(tables)
        for tables in (
            [record.truths[:, _LABEL].long() for record in records],
            [record.predictions for record in records],
        )
    )
    scene_of_true, scene = (
        torch.repeat_interleave(torch.arange(len(records)), torch.tensor(counts))
        for counts in (
            [len(record.truths) for record in records],
            [len(record.predictions) for record in records],
        )
    )
    rankings = {}
    for label in true_label.unique().tolist():
        own = (detections[:, _LABEL] == label).nonzero()[:, 0]
        own = own[score_order(detections[own, _SCORE])]
        rankings[class_names[label]] = ClassRanking(
            scene=scene[own].numpy(),
            matched=(detections[own, _MATCHED:] > 0).numpy(),
            n_true=torch.bincount(scene_of_true[true_label == label], minlength=len(records)).numpy(),
        )
    return rankings


def average_precision_of_draws(ranking: ClassRanking, column: int, drawn: NDArray[np.int64]) -> Counts:
    """Return a class's average precision in scenes some of which may count several times.

    Args:
        ranking: the detections.
        column: which threshold.
        drawn: ``(..., D)`` numbers of scenes.

    Returns:
        ``(...)``, NaN where none of the scenes has an object of the class.
    """
    times = _times(drawn, len(ranking.n_true))
    n_true = times @ ranking.n_true
    # Copies of a detection stand side by side: the envelope at their recalls is the precision after the last.
    weight = times[..., ranking.scene]
    right = weight * ranking.matched[:, column]
    precision = right.cumsum(axis=-1) / np.maximum(weight.cumsum(axis=-1), 1)
    envelope = np.maximum.accumulate(precision[..., ::-1], axis=-1)[..., ::-1]
    area = (envelope * right).sum(axis=-1)
    return np.where(n_true > 0, area / np.maximum(n_true, 1), np.nan)


def mean_of_draws(records: Sequence[SceneRecord], class_names: Sequence[str], column: int) -> OfScenes:
    """Return the mean average precision as a function of drawn scenes.

    Args:
        records: of scenes, or of the same scenes from two sides one after the other.
        class_names: of the labels.
        column: which threshold.
    """
    rankings = class_rankings(records, class_names)

    def mean(drawn: NDArray[np.int64]) -> Counts:
        by_class = [average_precision_of_draws(ranking, column, drawn) for ranking in rankings.values()]
        values = np.stack([np.zeros(drawn.shape[:-1]) * np.nan, *by_class])
        counted = np.isfinite(values)
        return np.where(counted, values, 0.0).sum(axis=0) / np.maximum(counted.sum(axis=0), 1)

    return mean


def _times(drawn: NDArray[np.int64], num_scenes: int) -> Counts:
    """Return how often each scene is drawn, ``(..., D)`` → ``(..., S)``."""
    flat = drawn.reshape(-1, drawn.shape[-1])
    times = np.zeros((len(flat), num_scenes))
    np.add.at(times, (np.arange(len(flat))[:, None], flat), 1)
    return times.reshape(*drawn.shape[:-1], num_scenes)


def _best(iou: Tensor) -> Tensor:
    """Return the highest IoU of each true object, ``(P, M)`` → ``(M,)``; 0 without detections."""
    return torch.cat([iou, iou.new_zeros(1, iou.shape[1])]).amax(dim=0)


def _mean(values: dict[str, float]) -> float:
    return sum(values.values()) / max(len(values), 1)
