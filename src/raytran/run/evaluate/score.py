# SPDX-License-Identifier: Apache-2.0
"""How good anybody's predictions are: files against annotations, without a model."""

from __future__ import annotations

import csv
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console

from raytran.errors import ConfigError
from raytran.metrics.per_scene import Row
from raytran.pictures.accuracy_curves import FILE as FIGURE
from raytran.run.evaluate.figure import Curves, draw_figure
from raytran.run.evaluate.files import PredictionFiles, read_predictions
from raytran.run.evaluate.protocols import (
    ProtocolScores,
    Truth,
    choose_protocols,
    compare,
    confidence,
    read_truth,
    score_protocol,
)
from raytran.run.evaluate.table import atlas_table, comparison_table, scores_table
from raytran.run.output import check_replaceable, replaced_folder

_log = logging.getLogger(__name__)

MARKER = "metrics.json"


def score(cfg: DictConfig, beside: Mapping[str, Curves]) -> dict[str, Any]:
    """Run ``python -m raytran.evaluate predictions=DIR annotations=FILE``; see ``conf/evaluate.yaml``.

    Args:
        cfg: the config of ``evaluate``.
        beside: accuracy curves of other results for the figure, by name.

    Returns:
        The content of ``metrics.json``.

    Raises:
        ConfigError: a setting is missing or does not go with the predictions.
        DataError: a file is missing or damaged.
    """
    if cfg.annotations is None:
        raise ConfigError("predictions= needs annotations=FILE, Scan2CAD's full_annotations.json")
    if cfg.num_resamples < 1:
        raise ConfigError(f"num_resamples={cfg.num_resamples} is too few, give at least 1")

    def path(name: str) -> Path | None:
        return None if cfg[name] is None else Path(cfg[name])

    metrics = score_predictions(
        Path(cfg.predictions),
        Path(cfg.annotations),
        cfg.protocol,
        compare_with=path("compare"),
        split=path("split"),
        scans=path("scans"),
        volume_extent=list(cfg.volume_extent),
        output=Path(cfg.output),
        num_resamples=cfg.num_resamples,
        seed=cfg.seed,
        beside=beside,
    )
    console = Console()
    console.print(scores_table(metrics, title=str(cfg.predictions)))
    if "strict" in metrics:
        console.print(atlas_table(metrics["strict"]["atlas"]))
    if "comparison" in metrics:
        console.print(comparison_table(metrics["comparison"], str(cfg.predictions), str(cfg.compare)))
    _log.info("wrote %s: %s", Path(cfg.output).resolve(), ", ".join(_written(metrics)))
    return metrics


def score_predictions(
    predictions: Path,
    annotations: Path,
    protocol: str = "strict",
    *,
    compare_with: Path | None = None,
    split: Path | None = None,
    scans: Path | None = None,
    volume_extent: Sequence[float] | None = None,
    output: Path | None = None,
    num_resamples: int = 2000,
    seed: int = 0,
    beside: Mapping[str, Curves] | None = None,
) -> dict[str, Any]:
    """Score the predictions for many scenes.

    Args:
        predictions: folder or file, see ``read_predictions``.
        annotations: Scan2CAD's ``full_annotations.json``.
        protocol: ``strict``, ``scan2cad``, ``vid2cad``, ``odam``, or ``all`` of them that apply.
        compare_with: other predictions for the same scenes.
        split: text file of the scenes that were asked for; None: all annotated ones.
        scans: ScanNet's ``scans`` folder, whose cameras tell where the voxel grid was.
        volume_extent: size of that grid, metres.
        output: folder for the results, which appear together or not at all, or None.
        num_resamples: draws of the bootstrap.
        seed: of the bootstrap.
        beside: accuracy curves of other results for the figure, by name; those of ``compare_with`` are there
            in any case.

    Returns:
        by protocol what its metric returns and ``confidence`` intervals; ``comparison`` by protocol.

    Raises:
        ConfigError: the protocol is unknown or does not fit the predictions, or ``output`` is in use.
        DataError: a file is missing or damaged.
    """
    if output is not None:
        check_replaceable(output.resolve(), marker=MARKER)
    truth = read_truth(annotations, split=split, scans=scans)
    files, scores = _by_protocol(protocol, predictions, truth, volume_extent)
    about = {"predictions": predictions, "annotations": annotations, "split": split}
    metrics: dict[str, Any] = {name: None if path is None else str(path) for name, path in about.items()}
    metrics |= files.counts()
    drawn = dict(beside or {})
    chance = {"num_resamples": num_resamples, "seed": seed}
    for name, part in scores.items():
        metrics[name] = part.metrics | {"confidence": confidence(part, **chance)}
    if compare_with is not None:
        others = _by_protocol(protocol, compare_with, truth)[1]
        metrics["comparison"] = {
            name: compare(part, others[name], **chance) for name, part in scores.items() if name in others
        }
        if "strict" in others:
            drawn = {str(compare_with): others["strict"].metrics["curves"], **drawn}
    if output is not None:
        _write(output, metrics, scores, drawn)
    return metrics


def _by_protocol(
    protocol: str, path: Path, truth: Truth, volume_extent: Sequence[float] | None = None
) -> tuple[PredictionFiles, dict[str, ProtocolScores]]:
    files = read_predictions(path, truth.objects, truth.cad_boxes)
    return files, {
        name: score_protocol(name, files, truth, volume_extent=volume_extent)
        for name in choose_protocols(protocol, files, path)
    }


def _write(
    output: Path,
    metrics: Mapping[str, Any],
    scores: Mapping[str, ProtocolScores],
    beside: Mapping[str, Curves],
) -> None:
    tables: dict[str, list[Row]] = {
        "per_object.csv": [
            {"protocol": name, **row} for name, part in scores.items() for row in part.objects
        ],
        "per_scene.csv": [{"protocol": name, **row} for name, part in scores.items() for row in part.scenes],
    }
    with replaced_folder(output, marker=MARKER) as folder:
        (folder / MARKER).write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
        for name, rows in tables.items():
            write_csv(folder / name, rows)
        if "strict" in scores:
            misses = [row for row in scores["strict"].objects if row["cause"] != "found"]
            content = {**metrics["strict"]["atlas"], "misses": misses}
            (folder / "atlas.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
            name = str(metrics["predictions"]) if beside else output.name
            draw_figure(folder, name, metrics["strict"]["curves"], beside)


def _written(metrics: Mapping[str, Any]) -> list[str]:
    of_strict = ["atlas.json", FIGURE] if "strict" in metrics else []
    return [MARKER, "per_object.csv", "per_scene.csv", *of_strict]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows whose columns differ by protocol: a cell that a row lacks stays empty."""
    columns = list(dict.fromkeys(column for row in rows for column in row)) or ["scene_id"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=columns, restval="")
        writer.writeheader()
        writer.writerows(rows)
