# SPDX-License-Identifier: Apache-2.0
"""The page of the demo: what its numbers are, what they prove, and pictures of two rooms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from raytran.checkpoints.card import provenance
from raytran.pictures.curves import draw_curves
from raytran.pictures.panels import contact_sheet, draw_frames, draw_masks, draw_occupancy
from raytran.pictures.report import Picture, Report, Section, SplitScores, write_report
from raytran.run.train.fit import FitResult
from raytran.structs import SceneBatch, ScenePrediction
from raytran.training.loggers import read_history

COLUMNS = {
    "train": "training rooms",
    "val": "held-out rooms",
    "shipped": "held-out rooms, raytran's own weights",
}
"""What was asked → what a reader is told it is, in the order of the page."""

_STAGES = {"stage1": "1 · occupancy", "stage2": "2 · all but shape", "stage3": "3 · shape"}


@dataclass(frozen=True)
class ShownScene:
    """A room to show.

    Attributes:
        column: one of ``COLUMNS``.
        folder: what ``write_scene`` wrote.
        batch: input and truth, B = 1.
        prediction: what was found.
        grid_extent: sizes of the voxel grid, metres.
    """

    column: str
    folder: Path
    batch: SceneBatch
    prediction: ScenePrediction
    grid_extent: tuple[float, float, float]


def headline(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Return the numbers to put first, as text, from the content of a ``metrics.json``."""
    accuracy = metrics["strict"]
    numbers = {"accuracy": f"{accuracy['global_average']:.0%}"}
    numbers["objects"] = f"{accuracy['n_good']} of {accuracy['n_total']}"
    for threshold, entry in metrics["strict"]["per_threshold"].items():
        numbers[f"F1 at IoU {threshold}"] = f"{entry['f1']:.2f}"
    for task, name in (("occupancy", "occupancy IoU"), ("foreground", "mask IoU")):
        if f"{task}_iou" in metrics:
            numbers[name] = f"{metrics[f'{task}_iou']:.2f}"
    if "shape" in metrics:
        iou = metrics["shape"]["iou"]
        numbers["shape IoU"] = "–" if iou is None else f"{iou:.2f}"
    return numbers


def write_page(
    output: Path,
    *,
    scenes: Sequence[ShownScene],
    metrics: Mapping[str, Mapping[str, Any]],
    fits: Sequence[FitResult],
    seconds: Mapping[str, float],
) -> Path:
    """Draw the pictures into ``output/pictures`` and write ``output/index.html``.

    Args:
        output: folder of the demo.
        scenes: rooms to show.
        metrics: content of ``metrics.json`` by column.
        fits: of the stages, in order.
        seconds: time of each step so far.

    Returns:
        The page.
    """
    pictures = output / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    histories = {_STAGES.get(fit.folder.name, fit.folder.name): read_history(fit.folder) for fit in fits}
    curves = draw_curves(pictures / "curves.png", histories)
    steps = ", ".join(f"{fit.steps:,}" for fit in fits)
    training = Section(
        "Training",
        f"Three fits, one after another, of {steps} steps: first what is occupied, then everything but the "
        "shapes, then the shapes alone while the rest is frozen.",
        [
            Picture(
                curves, "Terms of the loss against steps: the running mean, and the values behind.", wide=True
            )
        ],
    )
    report = Report(
        title="RayTran on generated rooms",
        summary=_summary(metrics),
        splits=[_scores(column, metrics) for column in metrics],
        sections=[*(_show(scene, pictures) for scene in scenes), training],
        steps=seconds,
        files=_files(output, scenes, fits),
        versions=_versions(),
    )
    return write_report(output / "index.html", report)


def _summary(metrics: Mapping[str, Mapping[str, Any]]) -> str:
    counts = {column: metrics[column]["strict"]["n_scenes"] for column in ("train", "val")}
    return (
        "Rooms were generated, a small network was trained from scratch through the three stages of the "
        f"paper, and then asked for the objects of the {counts['train']} training rooms and of "
        f"{counts['val']} held-out ones: class, position, size, heading and mesh, from posed frames alone."
    )


def _scores(column: str, metrics: Mapping[str, Mapping[str, Any]]) -> SplitScores:
    rooms = metrics["train"]["strict"]["n_scenes"]
    meaning = {
        "train": "The network was trained on these very rooms. High numbers prove that the whole chain "
        "learns, from pixels to boxes and meshes; they say nothing about other rooms.",
        "val": f"The network has never seen these rooms. So few training rooms (here {rooms}) cannot teach "
        "what furniture looks like in general, so low numbers are expected; many more are needed for that.",
        "shipped": "The same held-out rooms, asked of the weights that come with raytran. They learned from "
        "a thousand other rooms on two CPU cores; docs/results.md tells what to expect of them.",
    }
    per_class = metrics[column]["strict"]["per_class"]
    return SplitScores(
        title=COLUMNS[column].capitalize(),
        meaning=meaning[column],
        numbers=headline(metrics[column]),
        per_class={
            name: (entry["n_good"], entry["n_total"]) for name, entry in per_class.items() if entry["n_total"]
        },
    )


def _show(scene: ShownScene, pictures: Path) -> Section:
    batch, prediction = scene.batch, scene.prediction
    folder = pictures / scene.column
    folder.mkdir(exist_ok=True)
    in_order = dict.fromkeys(scene.folder / "overlays" / f"{name}.jpg" for name in batch.frame_id[0])
    overlays = [Image.open(path) for path in in_order if path.is_file()]
    shown = [
        Picture(
            scene.folder / "topdown.png", "From above. Filled: predicted; dashed: true; arrow heads: fronts."
        ),
        Picture(
            contact_sheet(folder / "overlays.jpg", overlays, columns=2),
            "Predicted boxes and meshes over frames; the front face of a box is drawn bold.",
        ),
        Picture(
            draw_frames(folder / "frames.jpg", batch.views),
            "Some of the frames the network was given.",
            wide=True,
        ),
    ]
    if prediction.foreground is not None:
        truth = None if batch.foreground is None else batch.foreground[0]
        masks = draw_masks(folder / "masks.jpg", batch.views, prediction.foreground, truth, columns=2)
        caption = "Where objects are, also where others hide them. Orange: predicted; white line: true."
        shown.append(Picture(masks, caption))
    if prediction.occupancy is not None:
        truth = None if batch.occupancy is None else batch.occupancy[0]
        height = scene.grid_extent[2]
        slices = draw_occupancy(folder / "occupancy.png", prediction.occupancy, truth, height=height)
        shown.append(Picture(slices, "Occupied voxels in four layers; heights count from the mean camera."))
    count = 0 if batch.objects is None else len(batch.objects[0])
    found = f"{len(prediction.objects)} objects were predicted, {count} are there."
    kind = "training" if scene.column == "train" else "held-out"
    by = ", by raytran's own weights" if scene.column == "shipped" else ""
    return Section(f"A {kind} room{by}: {prediction.scene_id}", found, shown)


def _files(output: Path, scenes: Sequence[ShownScene], fits: Sequence[FitResult]) -> dict[str, Path]:
    files = {f"3D scene of {s.folder.name} (glTF)": s.folder / "scene.glb" for s in scenes}
    files |= {f"meshes of {s.folder.name} (PLY)": s.folder / "meshes" for s in scenes}
    files["numbers by room and by object"] = output / "evaluation"
    files["trained network"] = fits[-1].checkpoint
    files["the rooms"] = output / "rooms"
    return files


def _versions() -> dict[str, str]:
    found = provenance()
    commit = {"commit": found["git_commit"]} if found["git_commit"] else {}
    return {**found["versions"], **commit, "platform": found["platform"]}
