# SPDX-License-Identifier: Apache-2.0
"""Scan2CAD accuracy: the share of annotated objects that are found with the right class and pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NotRequired, TypedDict

import torch
from torch import Tensor

from raytran.classes import PAPER_CLASSES
from raytran.errors import ConfigError
from raytran.metrics.functional.alignment import SCAN2CAD_LIMITS, AlignmentErrors, alignment_errors
from raytran.metrics.functional.cad_errors import cad_symmetries, equal_names
from raytran.metrics.functional.detection import match_in_order, score_order
from raytran.metrics.functional.scan2cad import match_scan2cad
from raytran.metrics.functional.vid2cad import VID2CAD_CLASS_BY_CATID, match_vid2cad
from raytran.metrics.per_scene import ProtocolMetric, Row, SceneRecord
from raytran.structs import CadAlignments, ObjectSet

SCAN2CAD_PROTOCOLS: tuple[str, ...] = ("strict", "scan2cad", "vid2cad")

_BED = "bed"
_CLASSES_OF_VID2CAD: tuple[str, ...] = (*PAPER_CLASSES.names[:-1], _BED)


class ClassAccuracy(TypedDict):
    """Accuracy on the objects of one class; 0 if there are none."""

    n_good: int
    n_total: int
    accuracy: float


class Scan2CADResult(TypedDict):
    """What ``Scan2CADAccuracy.compute`` returns.

    Only ``vid2cad`` has the two ``benchmark`` averages: over the eight classes without beds.
    """

    per_class: dict[str, ClassAccuracy]
    class_average: float
    global_average: float
    n_good: int
    n_total: int
    n_scenes: int
    benchmark_class_average: NotRequired[float]
    benchmark_global_average: NotRequired[float]


class Scan2CADAccuracy(ProtocolMetric):
    """Share of annotated objects that a prediction finds within 20 cm, 20 degrees and 20 % of size together.

    It is a recall: predictions too many cost nothing. Protocol ``strict``, which compares ``ObjectSet``s:

    - every scene counts, also one without predictions; all classes, matched by name;
    - predictions choose by score, and each takes the first annotated object still free that it fits;
    - translation is the distance of the box centres; size error is ``|mean(size / true size) - 1|``;
    - rotation is the full angle, the least over the annotated object's symmetry;
    - no cap on the number of predictions and no removal of duplicates.

    The other two give the counts of published scripts and compare ``CadAlignments``:

    - ``scan2cad``, Scan2CAD's own (``functional.scan2cad``): a scene whose predictions are None is left out,
      one with no predictions counts.
    - ``vid2cad``, ROCA's (``functional.vid2cad``): ``bed`` is a class and ``other`` is none; a scene without
      predictions adds to the totals of those classes that stand in a scene with predictions; the accuracy of
      a class, but not the global average, is rounded to 0.1 %.

    Args:
        protocol: ``"strict"``, ``"scan2cad"`` or ``"vid2cad"``.
        cad_symmetries: of each ``catid/id``, for ``scan2cad``, which looks the symmetry up over all scenes
            under test (``functional.cad_errors.cad_symmetries``). None: that of each scene's own annotation.
        max_translation: metres, inclusive.
        max_rotation: degrees, inclusive.
        max_scale: ratio, inclusive.
        **kwargs: see ``ObjectMetric``.

    Raises:
        ConfigError: the protocol is unknown.
    """

    # An object: label, whether it is found, then errors and score of the prediction that took it, else of the
    # nearest of its class (NaN if none). A prediction: label, score, whether it took an object. The label is
    # -1 for a class that the protocol does not have.
    truth_columns = 6
    prediction_columns = 3

    def __init__(
        self,
        *,
        protocol: str = "strict",
        cad_symmetries: Mapping[str, int] | None = None,
        max_translation: float = SCAN2CAD_LIMITS[0],
        max_rotation: float = SCAN2CAD_LIMITS[1],
        max_scale: float = SCAN2CAD_LIMITS[2],
        **kwargs: Any,
    ) -> None:
        if protocol not in SCAN2CAD_PROTOCOLS:
            known = ", ".join(SCAN2CAD_PROTOCOLS)
            raise ConfigError(f"unknown protocol {protocol!r} of Scan2CADAccuracy, choose one of: {known}")
        super().__init__(protocol=protocol, **kwargs)
        self.drops_missing = protocol == "scan2cad"
        self.class_names = _CLASSES_OF_VID2CAD if protocol == "vid2cad" else self.classes.names
        self.cad_symmetries = None if cad_symmetries is None else dict(cad_symmetries)
        self.limits = (max_translation, max_rotation, max_scale)

    def judge_objects(self, predictions: ObjectSet, targets: ObjectSet) -> tuple[Tensor, Tensor]:
        """Match by boxes."""
        errors = alignment_errors(predictions, targets)
        same_class = predictions.label[:, None] == targets.label
        match = match_in_order(score_order(predictions.score), same_class & errors.within(*self.limits))
        truths = _truths(targets.label, errors, same_class, match, predictions.score)
        label = predictions.label.double()
        return truths, torch.stack([label, predictions.score, (match >= 0).double()], dim=-1)

    def judge_cads(self, predictions: CadAlignments, targets: CadAlignments) -> tuple[Tensor, Tensor]:
        """Match by CAD alignments."""
        if self.protocol == "vid2cad":
            errors, match = match_vid2cad(predictions, targets, self.limits)
        else:
            symmetries = cad_symmetries([targets]) if self.cad_symmetries is None else self.cad_symmetries
            errors, match = match_scan2cad(predictions, targets, symmetries, self.limits)
        same_class = equal_names(predictions.catid, targets.catid)
        truths = _truths(self._labels(targets), errors, same_class, match, predictions.score)
        label = self._labels(predictions).double()
        return truths, torch.stack([label, predictions.score, (match >= 0).double()], dim=-1)

    def _labels(self, alignments: CadAlignments) -> Tensor:
        names: Sequence[str] = alignments.category
        if self.protocol == "vid2cad":
            names = [VID2CAD_CLASS_BY_CATID.get(catid, "") for catid in alignments.catid]
        number = {name: label for label, name in enumerate(self.class_names)}
        return torch.tensor([number.get(name, -1) for name in names], dtype=torch.int64)

    def compute(self) -> Scan2CADResult:
        """Return the accuracy of each class, the mean over those that occur, and that of all objects."""
        scenes = self.scenes()
        truths = self._counted(scenes)
        label, is_found = truths[:, 0].long(), truths[:, 1] == 1
        total = torch.bincount(label, minlength=len(self.class_names)).tolist()
        good = torch.bincount(label[is_found], minlength=len(self.class_names)).tolist()
        per_class = {
            name: ClassAccuracy(n_good=n_good, n_total=n_total, accuracy=self._accuracy(n_good, n_total))
            for name, n_good, n_total in zip(self.class_names, good, total, strict=True)
        }
        class_average, global_average = _averages(per_class)
        result = Scan2CADResult(
            per_class=per_class,
            class_average=class_average,
            global_average=global_average,
            n_good=sum(good),
            n_total=sum(total),
            n_scenes=len(scenes),
        )
        if self.protocol == "vid2cad":
            eight = {name: entry for name, entry in per_class.items() if name != _BED}
            result["benchmark_class_average"], result["benchmark_global_average"] = _averages(eight)
        return result

    def _counted(self, scenes: Sequence[SceneRecord]) -> Tensor:
        """Return the rows of the objects that count."""
        truths = self.truths()
        if self.protocol == "vid2cad":
            predicted_labels = {
                label for scene in scenes if len(scene.predictions) for label in scene.truths[:, 0].tolist()
            }
            truths = truths[
                torch.isin(truths[:, 0], torch.tensor(sorted(predicted_labels), dtype=truths.dtype))
            ]
        return truths[truths[:, 0] >= 0]

    def _accuracy(self, n_good: int, n_total: int) -> float:
        accuracy = n_good / max(n_total, 1)
        return round(100 * accuracy, 1) / 100 if self.protocol == "vid2cad" else accuracy

    def object_rows(self, record: SceneRecord) -> list[Row]:
        """Return whether each object is found, and the errors of its prediction or else of the nearest."""
        rows: list[Row] = []
        for index, (label, is_found, *values) in enumerate(record.truths.tolist()):
            if label < 0:
                continue
            translation, rotation, scale, score = (None if value != value else value for value in values)
            row: Row = {
                "scene_id": record.scene_id,
                "object": index,
                "category": self.class_names[int(label)],
            }
            row |= {
                "matched": bool(is_found),
                "translation_error_m": translation,
                "rotation_error_deg": rotation,
            }
            row |= {"scale_error": scale, "score": score}
            rows.append(row)
        return rows

    def scene_row(self, record: SceneRecord) -> Row:
        """Return the counts of one scene."""
        n_good, n_total = int(record.truths[:, 1].sum()), int((record.truths[:, 0] >= 0).sum())
        counts: Row = {"n_good": n_good, "n_total": n_total, "n_predicted": len(record.predictions)}
        return {"scene_id": record.scene_id, **counts, "accuracy": n_good / max(n_total, 1)}


def _averages(per_class: Mapping[str, ClassAccuracy]) -> tuple[float, float]:
    """Return the mean over the classes that occur, and the accuracy on all objects."""
    present = [entry["accuracy"] for entry in per_class.values() if entry["n_total"]]
    n_good, n_total = (sum(entry[key] for entry in per_class.values()) for key in ("n_good", "n_total"))
    return sum(present) / max(len(present), 1), n_good / max(n_total, 1)


def _truths(
    label: Tensor, errors: AlignmentErrors, same_class: Tensor, match: Tensor, score: Tensor
) -> Tensor:
    """Return the rows of the true objects."""
    n_true = len(label)
    taken_by = torch.full((n_true,), -1)
    taker = (match >= 0).nonzero().squeeze(1)
    taken_by[match[taker]] = taker
    shown = torch.where(taken_by >= 0, taken_by, _nearest(errors.translation, same_class))
    values = errors.translation.new_full((n_true, 4), torch.nan)
    some = (shown >= 0).nonzero().squeeze(1)
    of_shown = [error[shown[some], some] for error in errors]
    values[some] = torch.stack([*of_shown, score[shown[some]]], dim=-1)
    truths = torch.stack([label, taken_by >= 0], dim=-1).double()
    return torch.cat([truths, values], dim=-1)


def _nearest(distance: Tensor, same_class: Tensor) -> Tensor:
    """Return for each object the nearest prediction of its class, ``(P, M)`` → ``(M,)``, or -1."""
    if distance.shape[0] == 0:
        return torch.full((distance.shape[1],), -1)
    nearest = torch.where(same_class, distance.nan_to_num(nan=torch.inf), torch.inf).argmin(dim=0)
    return torch.where(same_class.any(dim=0), nearest, -1)
