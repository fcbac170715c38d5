# SPDX-License-Identifier: Apache-2.0
"""The results of an evaluation: what is written, and the tables for the terminal."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table

from raytran.data.text import read_json_object
from raytran.errors import ConfigError, DataError
from raytran.limits import POSITION, SHARE, as_numbers
from raytran.metrics.per_scene import Row
from raytran.pictures.accuracy_curves import FILE as FIGURE
from raytran.pictures.accuracy_curves import draw_accuracy_curves
from raytran.pictures.reliability import FILE as RELIABILITY
from raytran.pictures.reliability import draw_reliability
from raytran.run.output import replaced_folder

MARKER = "metrics.json"
"""The file that tells a finished result."""

PROTOCOLS: tuple[str, ...] = ("strict", "scan2cad", "vid2cad", "odam")
"""Those that compare with Scan2CAD's annotations, side by side if asked for."""

MAP = "map"
"""The protocol that compares boxes of any classes, by mean average precision."""

_PLAIN: dict[str, Any] = {"box": box.SIMPLE_HEAD, "pad_edge": False, "collapse_padding": True}
_CAPTION = escape("[low–high]: 95 % of bootstrap draws of the scenes")
_AVERAGES = {"class_average": "mean of classes", "global_average": "all objects"}
_DETECTION = {
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
    "average_precision": "AP",
}

Curves = Mapping[str, Any]
"""What ``AccuracyCurves.compute`` returns."""


@dataclass(frozen=True)
class Evaluation:
    """What came out of an evaluation, of a checkpoint or of predictions from files.

    Attributes:
        metrics: content of ``metrics.json``: what was measured, and the numbers, of objects by protocol.
        tables: name of a CSV file → its rows.
        misses: a row for each object that protocol ``strict`` counts as missed, for ``atlas.json``; None
            where that protocol was not followed.
        compared_with: name of other predictions, if ``metrics`` has a ``comparison`` with them.
        compared_curves: their accuracy curves; None where protocol ``strict`` was not followed.
    """

    metrics: dict[str, Any]
    tables: Mapping[str, Sequence[Row]]
    misses: Sequence[Row] | None = None
    compared_with: str | None = None
    compared_curves: Curves | None = None


def write_evaluation(
    output: Path, evaluation: Evaluation, *, other_curves: Mapping[str, Curves] | None = None
) -> list[str]:
    """Write ``metrics.json``, the CSV tables, ``atlas.json`` and the figures, all or nothing.

    Args:
        output: folder; replaced if it is an earlier result.
        evaluation: what to write; the figure needs curves of protocol ``strict``.
        other_curves: accuracy curves of other results for the figure, by name.

    Returns:
        The names of the files.

    Raises:
        ConfigError: ``output`` holds something that is no earlier result.
    """
    metrics = evaluation.metrics
    others = dict(other_curves or {})
    if evaluation.compared_with is not None and evaluation.compared_curves is not None:
        others = {evaluation.compared_with: evaluation.compared_curves, **others}
    with replaced_folder(output, marker=MARKER) as folder:
        (folder / MARKER).write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
        files = [MARKER]
        for name, rows in evaluation.tables.items():
            _write_csv(folder / name, rows)
            files.append(name)
        if evaluation.misses is not None:
            atlas = {**metrics["strict"]["atlas"], "misses": evaluation.misses}
            (folder / "atlas.json").write_text(json.dumps(atlas, indent=1) + "\n", encoding="utf-8")
            files.append("atlas.json")
        if "strict" in metrics:
            # Beside others a result is called after its predictions, alone after its folder.
            name = str(metrics.get("predictions", output.name)) if others else output.name
            draw_accuracy_curves(folder / FIGURE, {name: metrics["strict"]["curves"], **others})
            files.append(FIGURE)
        if "calibration" in metrics.get("strict", {}):
            draw_reliability(folder / RELIABILITY, metrics["strict"]["calibration"]["counted"])
            files.append(RELIABILITY)
    return files


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows whose columns differ by protocol: a cell that a row lacks stays empty."""
    columns = list(dict.fromkeys(column for row in rows for column in row)) or ["scene_id"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def read_curves(folders: Iterable[str | Path]) -> dict[str, Curves]:
    """Return the curves of earlier results, by the folder as it was given.

    Args:
        folders: each with a ``metrics.json`` that ``evaluate`` wrote.

    Raises:
        ConfigError: one has none, or no curves in it.
    """
    by_folder: dict[str, Curves] = {}
    for folder in folders:
        path = Path(folder) / MARKER
        try:
            curves = read_json_object(path)["strict"]["curves"]
            _check_curves(curves)
        except (DataError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(
                f"{path} has no curves of protocol strict to draw ({type(error).__name__}): draw_with= takes "
                "folders that raytran evaluate wrote with protocol=strict or all, or for a checkpoint"
            ) from error
        by_folder[str(folder)] = curves
    return by_folder


def _check_curves(curves: Curves) -> None:
    """Raise unless each curve has as many numbers as thresholds."""
    for name in ("translation", "rotation", "scale", "joint"):
        columns = [
            as_numbers(curves[name][column], (-1,), quantity, column)
            for column, quantity in (("threshold", POSITION), ("class_average", SHARE))
        ]
        if len(columns[0]) != len(columns[1]) or not len(columns[0]):
            raise ValueError(name)


def result_tables(evaluation: Evaluation, *, title: str) -> Iterator[Table]:
    """Give the tables for the terminal; ``title`` says what was measured."""
    metrics = evaluation.metrics
    if "new_views" in metrics:
        yield _new_views_table(metrics["new_views"], title)
        return
    if any(name in metrics for name in PROTOCOLS):
        yield _scores_table(metrics, title)
    if MAP in metrics:
        yield _map_table(metrics[MAP], title)
    if "strict" in metrics:
        yield _atlas_table(metrics["strict"]["atlas"])
    if evaluation.compared_with is not None:
        yield _comparison_table(metrics["comparison"], metrics["predictions"], evaluation.compared_with)


def _scores_table(metrics: Mapping[str, Any], title: str) -> Table:
    """Return the protocols side by side, and below them what a checkpoint predicts beside objects."""
    names = [name for name in PROTOCOLS if name in metrics]
    by_protocol = [metrics[name] for name in names]
    table = Table("", *names, title=escape(title), caption=_CAPTION, **_PLAIN)
    table.add_row("scenes", *(str(scores["n_scenes"]) for scores in by_protocol))
    table.add_section()
    classes = dict.fromkeys(
        name
        for scores in by_protocol
        for name, entry in scores.get("per_class", {}).items()
        if entry.get("n_total")
    )
    for category in classes:
        table.add_row(category, *(_class_cell(scores, category) for scores in by_protocol))
    table.add_section()
    for number, label in _AVERAGES.items():
        table.add_row(label, *(_percent_cell(scores, number) for scores in by_protocol))
    table.add_section()
    thresholds = dict.fromkeys(name for scores in by_protocol for name in scores.get("per_threshold", {}))
    for threshold in thresholds:
        for number, label in _DETECTION.items():
            cells = [_threshold_cell(scores, threshold, number) for scores in by_protocol]
            if any(cells):
                table.add_row(f"{label} @ {threshold}", *cells)
    table.add_section()
    for label, which in (("calibration error", "counted"), ("the same, of every score", "every_score")):
        errors = [_calibration_error(scores, which) for scores in by_protocol]
        if any(errors):
            table.add_row(label, *errors)
    table.add_section()
    for task in ("occupancy", "foreground"):
        if f"{task}_iou" in metrics:
            table.add_row(f"IoU of {task}", f"{metrics[f'{task}_iou']:.3f}")
    shape = metrics.get("shape", {})
    if shape.get("n_matched"):
        table.add_row(f"IoU of {shape['n_matched']} found objects' shapes", f"{shape['iou']:.3f}")
        if shape["chamfer_distance"] is not None:
            table.add_row("chamfer distance of these", f"{100 * shape['chamfer_distance']:.1f} cm")
    return table


def _map_table(scores: Mapping[str, Any], title: str) -> Table:
    """Return average precision and recall by class, as papers print them."""
    thresholds = [name for name in scores if name.startswith("iou_")]
    columns = [f"{what} @ {name.removeprefix('iou_')}" for name in thresholds for what in ("AP", "AR")]
    boxes = "oriented boxes" if scores["boxes"] == "oriented" else "axis-aligned boxes"
    shown = f"{title}: {scores['n_scenes']} scenes, {boxes}"
    table = Table("class", *columns, "true", "detected", title=escape(shown), caption=_CAPTION, **_PLAIN)
    for category, n_true in scores["n_true"].items():
        cells = [
            f"{scores[name][of][category]:.1%}"
            for name in thresholds
            for of in ("per_class", "recall_per_class")
        ]
        table.add_row(escape(category), *cells, str(n_true), str(scores["n_predicted"][category]))
    table.add_section()
    means = []
    for name in thresholds:
        means += [f"{scores[name]['mean']:.1%} {_interval(scores, name.replace('iou', 'map'))}"]
        means += [f"{scores[name]['mean_recall']:.1%}"]
    totals = (sum(scores[count].values()) for count in ("n_true", "n_predicted"))
    table.add_row("mean", *means, *map(str, totals))
    return table


def _class_cell(scores: Mapping[str, Any], category: str) -> str:
    entry = scores.get("per_class", {}).get(category, {})
    if not entry.get("n_total"):
        return ""
    return f"{entry['n_good']}/{entry['n_total']} {entry['accuracy']:.1%}"


def _percent_cell(scores: Mapping[str, Any], number: str) -> str:
    return f"{scores[number]:.1%} {_interval(scores, number)}" if number in scores else ""


def _threshold_cell(scores: Mapping[str, Any], threshold: str, number: str) -> str:
    entry = scores.get("per_threshold", {}).get(threshold, {})
    if number not in entry:
        return ""
    interval = _interval(scores, f"f1_{threshold}") if number == "f1" else ""
    return f"{entry[number]:.1%} {interval}".rstrip()


def _calibration_error(scores: Mapping[str, Any], which: str) -> str:
    error = scores.get("calibration", {}).get(which, {}).get("expected_error")
    return "" if error is None else f"{error:.3f}"


def _interval(scores: Mapping[str, Any], number: str) -> str:
    bounds = scores["confidence"].get(number)
    return "" if bounds is None else escape(f"[{100 * bounds['low']:.1f}–{100 * bounds['high']:.1f}]")


def _atlas_table(atlas: Mapping[str, Any]) -> Table:
    """Return why objects were missed under protocol ``strict``, by class, with the causes that occur."""
    causes = [cause for cause, count in atlas["objects"].items() if count]
    table = Table("class", *causes, title="error atlas (strict)", **_PLAIN)
    for category, counts in atlas["per_class"].items():
        if any(counts.values()):
            table.add_row(category, *(str(counts[cause]) for cause in causes))
    table.add_section()
    table.add_row("all", *(str(atlas["objects"][cause]) for cause in causes))
    return table


def _comparison_table(comparison: Mapping[str, Any], first: str, second: str) -> Table:
    """Return the differences of two sets of predictions on the scenes that count for both."""
    columns = ("protocol", "", "first", "second", "difference", "p")
    table = Table(*columns, title=escape(f"first: {first}, second: {second}"), **_PLAIN)
    table.caption = "p: permutation test over scenes, * below 0.05"
    for row in _comparison_rows(comparison):
        table.add_row(*row)
    return table


def _comparison_rows(comparison: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for protocol, numbers in comparison.items():
        for number, entry in numbers.items():
            yield (
                protocol,
                _AVERAGES.get(number, number.replace("f1_", "F1 @ ").replace("map_", "mAP @ ")),
                *(f"{entry[side]:.1%}" for side in ("first", "second")),
                f"{entry['difference']:+.1%} "
                + escape(f"[{100 * entry['low']:+.1f}, {100 * entry['high']:+.1f}]"),
                f"{entry['p_value']:.3f}" + (" *" if entry["significant"] else ""),
            )


def _new_views_table(new_views: Mapping[str, Any], title: str) -> Table:
    """Return what ``NewViewScores`` says of rendered views."""
    table = Table(f"{new_views['n_views']} new views", "PSNR, dB", "SSIM", title=escape(title), **_PLAIN)
    table.add_row("rendered", f"{new_views['psnr']:.2f}", f"{new_views['ssim']:.3f}")
    table.add_section()
    table.add_row("each view's own mean colour", f"{new_views['psnr_best_constant']:.2f}", "")
    table.add_row("the frame of the nearest camera", f"{new_views['psnr_nearest_frame']:.2f}", "")
    return table
