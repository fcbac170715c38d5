# SPDX-License-Identifier: Apache-2.0
"""How networks do on rooms and on real videos: ``python benchmarks/real.py CHECKPOINT … --rooms DIR …``.

One row a network: (a) the test rooms of rooms-v1, (b) those with held-out furniture, (c) a real scan with
true CAD alignments, (d) a real lounge with a few true boxes. ``evaluate`` and ``predict`` do the work, in
processes of their own. Videos are predicted from as a user would, with the frames that ``predict`` chooses.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from real_rows import KEY, keep_row
from record import circumstances, read_rows

from raytran.checkpoints.file import checkpoint_path, file_digest
from raytran.classes import OTHER, PAPER_CLASSES
from raytran.data.scan2cad import read_annotations, scene_objects
from raytran.export.read import read_scene_json
from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.metrics.functional.detection import match_in_order
from raytran.structs import ObjectSet

HERE = Path(__file__).parent

NEAR = 0.4
"""Metres within which the centre of a lounge's object is right."""

Figures = dict[str, float | int | None]


@dataclass(frozen=True)
class Trial:
    """A network and how it is asked.

    Attributes:
        checkpoint: as the commands take it.
        num_views: frames of a room.
        score_threshold: least score of an object that counts, None for the network's own.
        scenes: rooms of each set, None for all.
        folder: for what the commands write.
    """

    checkpoint: str
    num_views: int
    score_threshold: float | None
    scenes: int | None
    folder: Path


def run(*words: str) -> None:
    """Run a command of raytran, its progress on the terminal.

    Raises:
        SystemExit: it failed, and has said why.
    """
    done = subprocess.run([sys.executable, "-m", f"raytran.{words[0]}", *words[1:]], check=False)
    if done.returncode:
        raise SystemExit(f"raytran.{' '.join(words)} ended with code {done.returncode}")


def of_rooms(trial: Trial, root: Path) -> Figures:
    """Return what ``evaluate`` says of the test rooms, with the shapes of right objects."""
    metrics = _evaluated(trial, root, "rooms")
    shape = metrics.get("shape") or {}
    chairs = shape.get("per_class", {}).get("chair", {})
    return _figures("rooms", metrics) | {
        "rooms_shape_iou": shape.get("iou"),
        "rooms_chamfer_m": shape.get("chamfer_distance"),
        "rooms_chair_iou": chairs.get("iou"),
        "rooms_chair_chamfer_m": chairs.get("chamfer_distance"),
    }


def of_furniture(trial: Trial, root: Path) -> Figures:
    """Return what ``evaluate`` says of the rooms with other furniture, with the calibration.

    Generated pieces fill up where there are few given ones of a kind: the accuracy of the given is apart.
    """
    metrics = _evaluated(trial, root, "furniture")
    calibration = metrics["strict"]["calibration"]
    of_object = trial.folder / "furniture" / "per_object.csv"
    return _figures("furniture", metrics) | {
        "furniture_given_accuracy": accuracy_of_given(root, read_rows(of_object)),
        "furniture_calibration": calibration["counted"]["expected_error"],
        "furniture_calibration_every": calibration["every_score"]["expected_error"],
    }


def of_scan(trial: Trial, root: Path) -> Figures:
    """Return what ``evaluate`` says of predictions for real scans in the layout of ScanNet and Scan2CAD."""
    annotations, results = root / "scan2cad" / "full_annotations.json", trial.folder / "scan"
    true = {name: scene_objects(scene) for name, scene in read_annotations(annotations).items()}
    in_nothing = 0
    for scene_id, objects in true.items():
        _predict(trial, root / "scannet" / "scans" / scene_id, results / scene_id)
        predicted = read_scene_json(results / scene_id / "scene.json").objects
        in_nothing += int((~overlaps_any(predicted, objects)).sum())
    run(
        *("evaluate", f"predictions={results}", f"annotations={annotations}"),
        f"output={trial.folder / 'scan-scores'}",
    )
    metrics = json.loads((trial.folder / "scan-scores" / "metrics.json").read_text())
    return _figures("scan", metrics) | {"scan_in_nothing": in_nothing}


def of_lounge(trial: Trial, root: Path) -> Figures:
    """Return how many of the annotated pieces of a video are found.

    What is annotated as of no class of Scan2CAD counts as ``other``.
    """
    (scan,) = sorted((root / "scans").iterdir())
    _predict(trial, scan, trial.folder / "lounge")
    predicted = read_scene_json(trial.folder / "lounge" / "scene.json").objects
    pieces = json.loads((root / "boxes.json").read_text())["objects"]
    label = torch.tensor([PAPER_CLASSES.index(piece["scan2cad_class"] or OTHER) for piece in pieces])
    center = torch.tensor([piece["center"] for piece in pieces], dtype=torch.float64)
    return {
        "lounge_right": pieces_found(predicted, label, center),
        "lounge_true": len(pieces),
        "lounge_predicted": len(predicted),
    }


MEASURES: dict[str, Callable[[Trial, Path], Figures]] = {
    "rooms": of_rooms,
    "furniture": of_furniture,
    "scan": of_scan,
    "lounge": of_lounge,
}
"""Case, which is the option that names its folder → what measures it."""


def accuracy_of_given(root: Path, objects: Sequence[Mapping[str, str]]) -> float | None:
    """Return the share of right ones among the pieces that were given and not generated; None without any.

    Args:
        root: rooms that were furnished with given CAD models.
        objects: rows of ``per_object.csv`` of these rooms.
    """
    given = {model["model_id"] for model in json.loads((root / "cads.json").read_text())["models"]}
    scenes = read_annotations(root / "scan2cad" / "full_annotations.json")
    right = [
        row["matched"] == "True"
        for row in objects
        if scenes[row["scene_id"]].model_id[int(row["object"])].partition("/")[2] in given
    ]
    return sum(right) / len(right) if right else None


def overlaps_any(predicted: ObjectSet, true: ObjectSet) -> torch.Tensor:
    """Return whether each predicted box shares room with any true one, of whatever class, ``(P,)`` bool."""
    first, second = (
        OrientedBoxes(one.center.double(), one.size.double(), one.rotation.double())
        for one in (predicted, true)
    )
    return (box_iou(first, second)[1] > 0).any(dim=1)


def pieces_found(predicted: ObjectSet, label: torch.Tensor, center: torch.Tensor) -> int:
    """Return how many pieces have an object of their class whose centre is near, each with one of its own.

    Args:
        predicted: P objects; the surer ones choose first.
        label: ``(M,)`` int64, the class of each piece.
        center: ``(M, 3)`` its centre, metres.
    """
    distance = torch.cdist(predicted.center.double(), center)
    allowed = (distance <= NEAR) & (predicted.label[:, None] == label)
    order = predicted.score.argsort(descending=True, stable=True)
    return int((match_in_order(order, allowed, preference=-distance) >= 0).sum())


def _evaluated(trial: Trial, root: Path, name: str) -> dict[str, Any]:
    output = trial.folder / name
    few = [] if trial.scenes is None else [f"max_scenes={trial.scenes}"]
    run(
        *("evaluate", f"checkpoint={trial.checkpoint}", "data=scan2cad", f"data.root={root}", "split=test"),
        *(f"num_views={trial.num_views}", *_threshold(trial), *few),
        f"output={output}",
    )
    metrics: dict[str, Any] = json.loads((output / "metrics.json").read_text())
    return metrics


def _threshold(trial: Trial) -> list[str]:
    return [] if trial.score_threshold is None else [f"score_threshold={trial.score_threshold}"]


def _predict(trial: Trial, scene: Path, output: Path) -> None:
    """Predict a video as a user would, without the pictures."""
    run(
        *("predict", f"checkpoint={trial.checkpoint}", f"scene={scene}", f"output={output}"),
        *(*_threshold(trial), "viewer=false", "turntable=0", "num_overlays=0"),
    )


def _figures(case: str, metrics: Mapping[str, Any]) -> Figures:
    boxes = metrics["strict"]["per_threshold"]["0.25"]
    return {
        f"{case}_accuracy": metrics["strict"]["global_average"],
        f"{case}_f1": boxes["f1"],
        f"{case}_predicted": boxes["n_predicted"],
        f"{case}_true": boxes["n_true"],
    }


def measured(trial: Trial, folders: Mapping[str, Path]) -> Figures:
    """Return the figures of all cases whose folder is there; the others are left out with a word."""
    figures: Figures = {}
    for case, measure in MEASURES.items():
        if case not in folders:
            print(f"{case}: left out, give --{case}")
        elif not folders[case].is_dir():
            print(f"{case}: left out, there is no folder {folders[case]}")
        else:
            print(f"{case}: {trial.checkpoint} on {folders[case]}", flush=True)
            began = time.monotonic()
            found = measure(trial, folders[case])
            print(f"{case}: {_in_words(found)} ({time.monotonic() - began:.0f} s)", flush=True)
            figures |= found
    return figures


def _in_words(figures: Figures) -> str:
    shown = (f"{name.partition('_')[2]} {value:.4g}" for name, value in figures.items() if value is not None)
    return ", ".join(shown)


def main() -> None:
    """Measure the networks and keep a row for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoints", nargs="+", help="checkpoints, weights, or default")
    parser.add_argument("--names", nargs="+", help="what to call them; else after the end of their path")
    parser.add_argument("--rooms", type=Path, help="(a) rooms-v1, as prepare dataset=rooms-v1 makes it")
    parser.add_argument("--furniture", type=Path, help="(b) dataset=rooms-v1-furniture part=held_out")
    parser.add_argument("--scan", type=Path, help="(c) folder with scannet/scans and scan2cad")
    parser.add_argument("--lounge", type=Path, help="(d) folder with one scan in scans, and boxes.json")
    parser.add_argument("--num-views", type=int, default=24, help="frames of a room")
    parser.add_argument("--score-threshold", type=float, help="else the network's own")
    parser.add_argument("--scenes", type=int, help="only the first rooms of each set, for a quick look")
    parser.add_argument("--table", type=Path, default=HERE / "real.csv", help="file that keeps the rows")
    parser.add_argument("--output", type=Path, help="folder that keeps what the commands write")
    arguments = parser.parse_args()
    names = arguments.names or [_name(checkpoint) for checkpoint in arguments.checkpoints]
    if len(names) != len(arguments.checkpoints):
        parser.error("give as many names as checkpoints")
    folders = {case: getattr(arguments, case) for case in MEASURES if getattr(arguments, case) is not None}
    for name, checkpoint in zip(names, arguments.checkpoints, strict=True):
        sha256 = file_digest(checkpoint_path(checkpoint))[:12]
        with tempfile.TemporaryDirectory() as temporary:
            kept = Path(temporary) if arguments.output is None else arguments.output / sha256
            how = (arguments.num_views, arguments.score_threshold, arguments.scenes)
            figures = measured(Trial(checkpoint, *how, folder=kept), folders)
        if not figures:
            raise SystemExit("nothing to measure on: give at least one folder")
        key = dict(zip(KEY, (sha256, how[0], how[1] or "own", how[2] or "all"), strict=True))
        date_commit = {"date": circumstances()["date"], "commit": circumstances()["commit"]}
        lost = keep_row(arguments.table, {"name": name, **key, **date_commit, **figures})
        if lost:
            print(f"figures of an earlier commit are gone from the row: {', '.join(lost)}")
        print(f"wrote the row of {name} to {arguments.table}")


def _name(checkpoint: str) -> str:
    """Return the end of a checkpoint's path: what lies before it is of this machine alone."""
    return "/".join(Path(checkpoint).parts[-3:])


if __name__ == "__main__":
    main()
