# SPDX-License-Identifier: Apache-2.0
"""The scores of predictions from files under each protocol; intervals and comparisons over scenes."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from raytran.classes import PAPER_CLASSES, Classes
from raytran.data.scan2cad import SceneAnnotation, read_annotations, scene_alignments
from raytran.data.scannet.scan import read_scan
from raytran.data.scene_list import annotated_objects
from raytran.data.text import read_names
from raytran.errors import ConfigError, DataError
from raytran.export.read import CadBoxes, PredictionFiles, read_predictions
from raytran.metrics.bootstrap import (
    Comparison,
    Counts,
    Interval,
    Statistic,
    bootstrap_interval,
    class_average,
    class_counts,
    compare_paired,
    f1,
    global_average,
)
from raytran.metrics.box_f1 import OrientedBoxF1
from raytran.metrics.functional.cad_errors import cad_symmetries
from raytran.metrics.per_scene import Row, check_protocol_classes
from raytran.metrics.scan2cad import Scan2CADAccuracy
from raytran.metrics.strict import StrictScores, side_by_side
from raytran.run.evaluate.results import PROTOCOLS, Evaluation
from raytran.structs import CadAlignments, ObjectSet

_log = logging.getLogger(__name__)

ALL_PROTOCOLS = "all"
_NEEDS_CADS = ("scan2cad", "vid2cad")


@dataclass(frozen=True)
class ProtocolScores:
    """What one protocol says of one set of predictions.

    Attributes:
        metrics: the part of ``metrics.json`` under the protocol's name.
        objects: a row for each annotated object that counts.
        scenes: a row for each scene that counts.
    """

    metrics: dict[str, Any]
    objects: list[Row]
    scenes: list[Row]

    def misses(self) -> list[Row]:
        """Return the rows of the objects that protocol ``strict`` counts as missed."""
        return [row for row in self.objects if row["cause"] != "found"]


@dataclass(frozen=True)
class Truth:
    """The annotated scenes that are asked for, in the forms that the protocols compare."""

    objects: dict[str, ObjectSet]
    alignments: dict[str, CadAlignments]
    cad_boxes: CadBoxes
    volume_center: dict[str, Tensor]
    classes: Classes = PAPER_CLASSES


def evaluate_predictions(
    predictions: Path,
    annotations: Path,
    protocol: str = "strict",
    *,
    compare_with: Path | None = None,
    split: Path | None = None,
    scans: Path | None = None,
    volume_extent: Sequence[float] | None = None,
    num_resamples: int = 2000,
    seed: int = 0,
    classes: Classes = PAPER_CLASSES,
) -> Evaluation:
    """Score the predictions for many scenes.

    Args:
        predictions: folder or file, see ``read_predictions``.
        annotations: Scan2CAD's ``full_annotations.json``.
        protocol: ``strict``, ``scan2cad``, ``vid2cad``, ``odam``, or ``all`` of them that apply.
        compare_with: other predictions for the same scenes.
        split: text file of the scenes that were asked for; None: all annotated ones.
        scans: ScanNet's ``scans`` folder, whose cameras tell where the voxel grid was.
        volume_extent: size of that grid, metres.
        num_resamples: draws of the bootstrap.
        seed: of the bootstrap.
        classes: that objects are of, for protocol ``strict``; the others have their own.

    Returns:
        by protocol what its metric returns and ``confidence`` intervals; ``comparison`` by protocol.

    Raises:
        ConfigError: the protocol is unknown or does not fit the predictions.
        DataError: a file is missing or damaged.
    """
    truth = read_truth(annotations, split=split, scans=scans, classes=classes)
    files, scores = _scores_by_protocol(protocol, predictions, truth, volume_extent)
    paths = {"predictions": predictions, "annotations": annotations, "split": split}
    metrics: dict[str, Any] = {name: None if path is None else str(path) for name, path in paths.items()}
    metrics |= files.counts()
    for name, of_protocol in scores.items():
        intervals = confidence(of_protocol, num_resamples=num_resamples, seed=seed)
        metrics[name] = of_protocol.metrics | {"confidence": intervals}
    compared_curves = None
    if compare_with is not None:
        _, others = _scores_by_protocol(protocol, compare_with, truth)
        metrics["comparison"] = {
            name: compare(scores[name], others[name], num_resamples=num_resamples, seed=seed)
            for name in scores
            if name in others
        }
        compared_curves = others["strict"].metrics["curves"] if "strict" in others else None
    return Evaluation(
        metrics,
        tables={
            "per_object.csv": [{"protocol": name, **row} for name in scores for row in scores[name].objects],
            "per_scene.csv": [{"protocol": name, **row} for name in scores for row in scores[name].scenes],
        },
        misses=scores["strict"].misses() if "strict" in scores else None,
        compared_with=None if compare_with is None else str(compare_with),
        compared_curves=compared_curves,
    )


def _scores_by_protocol(
    protocol: str, path: Path, truth: Truth, volume_extent: Sequence[float] | None = None
) -> tuple[PredictionFiles, dict[str, ProtocolScores]]:
    files = read_predictions(path, truth.objects, truth.cad_boxes, truth.classes)
    protocols = choose_protocols(protocol, files, path, truth.classes)
    return files, {
        name: score_protocol(name, files, truth, volume_extent=volume_extent) for name in protocols
    }


def read_truth(
    annotations: Path,
    *,
    split: Path | None = None,
    scans: Path | None = None,
    classes: Classes = PAPER_CLASSES,
) -> Truth:
    """Read the annotated scenes.

    Args:
        annotations: Scan2CAD's ``full_annotations.json``.
        split: text file of scene names, one a line; None: all scenes of the annotations.
        scans: folder of ScanNet scans, whose cameras tell where each voxel grid was; None: unknown.
        classes: that objects are of; others are no ``objects``.

    Raises:
        DataError: a file is missing or damaged, or no scene of the split is annotated.
    """
    scenes = read_annotations(annotations)
    chosen = _of_split(scenes, split, annotations)
    centers = {} if scans is None else {name: _volume_center(scans / name) for name in chosen}
    return Truth(
        objects=dict(zip(chosen, annotated_objects(chosen, list(chosen), classes), strict=True)),
        alignments={name: scene_alignments(scene) for name, scene in chosen.items()},
        cad_boxes={
            name: (center, half)
            for scene in scenes.values()
            for name, center, half in zip(scene.model_id, scene.box_center, scene.box_half_size, strict=True)
        },
        volume_center=centers,
        classes=classes,
    )


def _of_split(
    scenes: Mapping[str, SceneAnnotation], split: Path | None, annotations: Path
) -> dict[str, SceneAnnotation]:
    if split is None:
        return dict(scenes)
    names = set(read_names(split))
    chosen = {name: scene for name, scene in scenes.items() if name in names}
    if not chosen:
        raise DataError(f"none of the {len(names)} scenes that {split} names is annotated in {annotations}")
    return chosen


def _volume_center(scan: Path) -> Tensor:
    """Return the mean camera position, on which the voxel grid of a scan is centred."""
    return read_scan(scan).world_from_camera[:, :3, 3].mean(dim=0)


def choose_protocols(
    protocol: str, files: PredictionFiles, path: Path, classes: Classes = PAPER_CLASSES
) -> tuple[str, ...]:
    """Return the protocols to follow.

    Raises:
        ConfigError: the protocol is unknown, is defined on other classes, or compares CAD models, which the
            predictions do not name.
    """
    if protocol not in (*PROTOCOLS, ALL_PROTOCOLS):
        known = ", ".join((*PROTOCOLS, ALL_PROTOCOLS))
        raise ConfigError(f"unknown protocol={protocol}, choose one of: {known}")
    if classes.names != PAPER_CLASSES.names:
        if protocol not in ("strict", ALL_PROTOCOLS):
            check_protocol_classes(protocol, classes)
        return ("strict",)
    without = [scene.path for scene in files.scenes.values() if scene.cads is None]
    possible = tuple(name for name in PROTOCOLS if not (without and name in _NEEDS_CADS))
    if protocol == ALL_PROTOCOLS:
        if without:
            _log.warning("%s has objects without CAD models: only %s apply", without[0], ", ".join(possible))
        return possible
    if protocol not in possible:
        raise ConfigError(
            f"protocol={protocol} compares CAD models, and {without[0]} has objects without catid_cad and "
            f"id_cad: choose one of {', '.join(possible)}"
        )
    return (protocol,)


def score_protocol(
    protocol: str, files: PredictionFiles, truth: Truth, *, volume_extent: Sequence[float] | None = None
) -> ProtocolScores:
    """Score predictions under one protocol.

    Under ``strict`` and ``vid2cad`` scenes without a file count as scenes in which nothing was found; under
    ``scan2cad`` and ``odam`` they do not count at all, as in the official scripts.
    """
    if protocol == "strict":
        return _score_strict(files, truth, volume_extent)
    if protocol == "odam":
        names = [name for name in truth.alignments if name in files.scenes]
        boxes = [files.scenes[name].boxes for name in names]
        half_extents = {name: half.tolist() for name, (_, half) in truth.cad_boxes.items()}
        metric: OrientedBoxF1 | Scan2CADAccuracy = OrientedBoxF1(
            protocol="odam", cad_half_extents=half_extents
        )
    else:
        names = [name for name in truth.alignments if name in files.scenes or protocol == "vid2cad"]
        predicted = {name: scene.cads for name, scene in files.scenes.items()}
        boxes = [predicted.get(name) or CadAlignments.empty() for name in names]
        symmetries = cad_symmetries(truth.alignments[name] for name in names)
        metric = Scan2CADAccuracy(protocol=protocol, cad_symmetries=symmetries)
    metric.update(boxes, [truth.alignments[name] for name in names], names)
    return ProtocolScores(dict(metric.compute()), metric.rows("object"), metric.rows("scene"))


def _score_strict(
    files: PredictionFiles, truth: Truth, volume_extent: Sequence[float] | None
) -> ProtocolScores:
    names, targets = list(truth.objects), list(truth.objects.values())
    num_missing = sum(name not in files.scenes for name in names)
    if num_missing:
        _log.warning(
            "%d of %d scenes have no predictions, and count as scenes in which nothing was found; name the "
            "scenes that were asked for with split=FILE",
            *(num_missing, len(names)),
        )
    predicted = {name: scene.objects for name, scene in files.scenes.items()}
    predictions = [predicted.get(name, ObjectSet.empty()) for name in names]
    scores = StrictScores(volume_extent=volume_extent, classes=truth.classes)
    scores.update(predictions, targets, names, [truth.volume_center.get(name) for name in names])
    return ProtocolScores(
        scores.compute(),
        side_by_side("object", scores.accuracy, scores.box_f1, scores.atlas),
        side_by_side("scene", scores.accuracy, scores.box_f1),
    )


def confidence(scores: ProtocolScores, *, num_resamples: int, seed: int) -> dict[str, Interval]:
    """Return the 95 % intervals of a protocol's main numbers over its scenes."""
    names = [str(row["scene_id"]) for row in scores.scenes]
    return {
        number: bootstrap_interval(
            _counts(number, scores, names, _classes(scores)),
            statistic,
            num_resamples=num_resamples,
            seed=seed,
        )
        for number, statistic in _statistics(scores).items()
    }


def compare(
    first: ProtocolScores, second: ProtocolScores, *, num_resamples: int, seed: int
) -> dict[str, Comparison]:
    """Compare two sets of predictions under one protocol, on the scenes that count for both."""
    others = {row["scene_id"] for row in second.scenes}
    names = [str(row["scene_id"]) for row in first.scenes if row["scene_id"] in others]
    classes = sorted({*_classes(first), *_classes(second)})
    return {
        number: compare_paired(
            _counts(number, first, names, classes),
            _counts(number, second, names, classes),
            statistic,
            num_resamples=num_resamples,
            seed=seed,
        )
        for number, statistic in _statistics(first).items()
    }


def _statistics(scores: ProtocolScores) -> dict[str, Statistic]:
    """Return the main numbers of a protocol and how each follows from sums over scenes."""
    statistics: dict[str, Statistic] = {}
    if "per_class" in scores.metrics:
        statistics |= {"class_average": class_average, "global_average": global_average}
    return statistics | {f"f1_{threshold}": f1 for threshold in scores.metrics.get("per_threshold", {})}


def _classes(scores: ProtocolScores) -> list[str]:
    """Return the classes that count; those of a protocol may be fewer than those of its rows."""
    return [name for name, entry in scores.metrics.get("per_class", {}).items() if entry["n_total"]]


def _counts(number: str, scores: ProtocolScores, names: Sequence[str], classes: Sequence[str]) -> Counts:
    """Return what each scene adds to the sums behind a number, ``(S, C)``."""
    if not number.startswith("f1_"):
        return class_counts([row for row in scores.objects if row["category"] in classes], names, classes)
    by_name = {row["scene_id"]: row for row in scores.scenes}
    columns = (number.replace("f1", "n_matched"), "n_predicted", "n_true")
    rows = [[float(by_name[name][column] or 0) for column in columns] for name in names]
    return np.array(rows, dtype=np.float64).reshape(len(names), len(columns))
