# SPDX-License-Identifier: Apache-2.0
"""The scores of predictions from files under each protocol; intervals and comparisons over scenes."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from torch import Tensor

from raytran.classes import PAPER_CLASSES, Classes
from raytran.data.scan2cad import SceneAnnotation, read_annotations, scene_alignments
from raytran.data.scannet.scan import read_scan
from raytran.data.scene_list import annotated_objects
from raytran.data.text import read_names
from raytran.errors import ConfigError, DataError
from raytran.export.read import (
    CadBoxes,
    PredictionFiles,
    files_by_scene,
    read_named_boxes,
    read_predictions,
)
from raytran.metrics.average_precision import MeanAveragePrecision, mean_of_draws
from raytran.metrics.bootstrap import (
    Comparison,
    Counts,
    Interval,
    OfScenes,
    Statistic,
    bootstrap_interval,
    class_average,
    class_counts,
    compare_paired,
    comparison_of_scenes,
    f1,
    global_average,
    interval_of_scenes,
)
from raytran.metrics.box_f1 import OrientedBoxF1
from raytran.metrics.functional.cad_errors import cad_symmetries
from raytran.metrics.per_scene import Row, SceneRecord, check_protocol_classes
from raytran.metrics.scan2cad import Scan2CADAccuracy
from raytran.metrics.strict import StrictScores, side_by_side
from raytran.run.evaluate.results import MAP, PROTOCOLS, Evaluation
from raytran.structs import CadAlignments, ObjectSet

_log = logging.getLogger(__name__)

ALL_PROTOCOLS = "all"
_NEEDS_CADS = ("scan2cad", "vid2cad")

_Scene = TypeVar("_Scene", SceneAnnotation, Path)


@dataclass(frozen=True)
class ProtocolScores:
    """What one protocol says of one set of predictions.

    Attributes:
        metrics: the part of ``metrics.json`` under the protocol's name.
        objects: a row for each annotated object that counts.
        scenes: a row for each scene that counts.
        of_map: what judged them by protocol ``map``; its numbers follow from no sum over scenes.
    """

    metrics: dict[str, Any]
    objects: list[Row]
    scenes: list[Row]
    of_map: MeanAveragePrecision | None = None

    def misses(self) -> list[Row]:
        """Return the rows of the objects that protocol ``strict`` counts as missed."""
        return [row for row in self.objects if row["cause"] != "found"]


@dataclass(frozen=True)
class Truth:
    """The annotated scenes that are asked for, in the forms that the protocols compare.

    Attributes:
        objects: boxes by scene.
        alignments: CAD alignments by scene; empty if the annotations are a folder of boxes.
        cad_boxes: of each CAD model.
        volume_center: ``(3,)`` centre of each scene's voxel grid, where it is known.
        classes: of the objects; those that occur, in a folder of boxes.
        only_boxes: the annotations are such a folder.
    """

    objects: dict[str, ObjectSet]
    alignments: dict[str, CadAlignments]
    cad_boxes: CadBoxes
    volume_center: dict[str, Tensor]
    classes: Classes = PAPER_CLASSES
    only_boxes: bool = False


def evaluate_predictions(
    predictions: Path,
    annotations: Path,
    protocol: str = "strict",
    *,
    boxes: str = "oriented",
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
        annotations: Scan2CAD's ``full_annotations.json``; for ``map`` also a folder of true boxes, see
            ``read_truth``.
        protocol: ``strict``, ``scan2cad``, ``vid2cad``, ``odam``, or ``all`` of these that apply; or ``map``.
        boxes: of ``map``, see ``MeanAveragePrecision``.
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
    files, scores = _scores_by_protocol(protocol, predictions, truth, boxes, volume_extent)
    paths = {"predictions": predictions, "annotations": annotations, "split": split}
    metrics: dict[str, Any] = {name: None if path is None else str(path) for name, path in paths.items()}
    metrics |= files.counts()
    for name, of_protocol in scores.items():
        intervals = confidence(of_protocol, num_resamples=num_resamples, seed=seed)
        metrics[name] = of_protocol.metrics | {"confidence": intervals}
    compared_curves = None
    if compare_with is not None:
        _, others = _scores_by_protocol(protocol, compare_with, truth, boxes)
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
    protocol: str, path: Path, truth: Truth, boxes: str, volume_extent: Sequence[float] | None = None
) -> tuple[PredictionFiles, dict[str, ProtocolScores]]:
    if protocol == MAP:
        files = read_predictions(path, truth.objects, truth.cad_boxes, truth.classes, leave_out_others=True)
        return files, {MAP: _score_map(files, truth, boxes)}
    if truth.only_boxes and protocol in (*PROTOCOLS, ALL_PROTOCOLS):
        raise ConfigError(
            f"protocol={protocol} compares with Scan2CAD's full_annotations.json: give that as annotations=, "
            f"or protocol={MAP} for a folder of boxes"
        )
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
        annotations: Scan2CAD's ``full_annotations.json``, or a folder of true boxes of any classes, in the
            forms of predictions that name classes: ``<scene_id>.json`` (``raytran.scene/1``, whose scores do
            not matter and may be missing), or Boxer's CSV.
        split: text file of scene names, one a line; None: all scenes of the annotations.
        scans: folder of ScanNet scans, whose cameras tell where each voxel grid was; None: unknown.
        classes: that objects are of; others are no ``objects``.

    Raises:
        DataError: a file is missing or damaged, or no scene of the split is annotated.
    """
    if annotations.is_dir():
        return _truth_of_boxes(annotations, split)
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


def _truth_of_boxes(folder: Path, split: Path | None) -> Truth:
    """Read a folder of true boxes; their classes are those that occur, in the order of their names."""
    files = _of_split(files_by_scene(folder), split, folder)
    scenes = {name: read_named_boxes(path, name, scored=False, flat=True) for name, path in files.items()}
    names = tuple(sorted({category for scene in scenes.values() for category in scene.category}))
    if not names:
        raise DataError(f"{folder} holds no true boxes: name the files <scene_id>.json (raytran.scene/1)")
    classes = Classes(names)
    objects = {name: scene.labelled(classes) for name, scene in scenes.items()}
    return Truth(objects, {}, {}, {}, classes, only_boxes=True)


def _of_split(scenes: Mapping[str, _Scene], split: Path | None, annotations: Path) -> dict[str, _Scene]:
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
        known = ", ".join((*PROTOCOLS, ALL_PROTOCOLS, MAP))
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
    names, predictions, targets = _every_scene(files, truth)
    scores = StrictScores(volume_extent=volume_extent, classes=truth.classes)
    scores.update(predictions, targets, names, [truth.volume_center.get(name) for name in names])
    return ProtocolScores(
        scores.compute(),
        side_by_side("object", scores.accuracy, scores.box_f1, scores.atlas),
        side_by_side("scene", scores.accuracy, scores.box_f1),
    )


def _score_map(files: PredictionFiles, truth: Truth, boxes: str) -> ProtocolScores:
    names, predictions, targets = _every_scene(files, truth)
    metric = MeanAveragePrecision(boxes=boxes, classes=truth.classes)
    metric.update(predictions, targets, names)
    return ProtocolScores(metric.compute(), metric.rows("object"), metric.rows("scene"), metric)


def _every_scene(files: PredictionFiles, truth: Truth) -> tuple[list[str], list[ObjectSet], list[ObjectSet]]:
    """Return names, predictions and true objects of all scenes; a line tells how many have no predictions."""
    names, targets = list(truth.objects), list(truth.objects.values())
    num_missing = sum(name not in files.scenes for name in names)
    if num_missing:
        _log.warning(
            "%d of %d scenes have no predictions, and count as scenes in which nothing was found; name the "
            "scenes that were asked for with split=FILE",
            *(num_missing, len(names)),
        )
    predicted = {name: scene.objects for name, scene in files.scenes.items()}
    return names, [predicted.get(name, ObjectSet.empty()) for name in names], targets


def confidence(scores: ProtocolScores, *, num_resamples: int, seed: int) -> dict[str, Interval]:
    """Return the 95 % intervals of a protocol's main numbers over its scenes."""
    if scores.of_map is not None:
        records = scores.of_map.scenes_by_name()
        return {
            name: interval_of_scenes(of_scenes, len(records), num_resamples=num_resamples, seed=seed)
            for name, of_scenes in _means_of_draws(scores.of_map, records).items()
        }
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
    if first.of_map is not None and second.of_map is not None:
        own = first.of_map.scenes_by_name()
        both = [*own, *second.of_map.scenes_by_name()]  # of the same scenes: each counts for both sides
        return {
            name: comparison_of_scenes(of_rows, len(own), num_resamples=num_resamples, seed=seed)
            for name, of_rows in _means_of_draws(first.of_map, both).items()
        }
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


def _means_of_draws(metric: MeanAveragePrecision, records: Sequence[SceneRecord]) -> dict[str, OfScenes]:
    """Return the mean average precision at each threshold as a function of drawn scenes, by name."""
    return {
        f"map_{threshold:g}": mean_of_draws(records, metric.classes.names, column)
        for column, threshold in enumerate(metric.iou_thresholds)
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
