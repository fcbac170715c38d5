# SPDX-License-Identifier: Apache-2.0
"""The page of the demo: what its numbers are, what they prove, and pictures of two rooms."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from raytran.checkpoints.metadata import provenance
from raytran.data.images import decode_image
from raytran.errors import page
from raytran.pictures.curves import draw_curves
from raytran.pictures.page import data_uri
from raytran.pictures.page import write_page as fill_template
from raytran.pictures.palette import INK
from raytran.pictures.panels import contact_sheet, draw_frames, draw_masks, draw_occupancy
from raytran.run.train.fit import FitResult
from raytran.structs import SceneBatch, ScenePrediction
from raytran.training.history import read_history
from raytran.viewer import HTML

COLUMNS = {
    "train": "training rooms",
    "val": "held-out rooms",
    "shipped": "held-out rooms, raytran's own weights",
}
"""What was asked → what a reader is told it is, in the order of the page."""

_MEDIA = {".png": "image/png", ".jpg": "image/jpeg"}
_TO_LOOK_AT = {HTML: "walk around in 3D", "turntable.gif": "one turn around the objects (GIF)"}
"""Files of a room that are too large for the page → what a link to them says."""

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

    The pictures become part of the page, so the file can be sent by itself.

    Args:
        output: folder of the demo.
        scenes: rooms to show.
        metrics: content of ``metrics.json`` by column.
        fits: of the stages, in order.
        seconds: time of each step.
    """
    (output / "pictures").mkdir(parents=True, exist_ok=True)
    splits = [_split(column, metrics) for column in metrics]
    colors = {
        name: of_scene.hex(label)
        for of_scene in (scene.prediction.objects.classes for scene in scenes)
        for label, name in enumerate(of_scene.names)
    }
    present = dict.fromkeys([*colors, *(name for split in splits for name in split["per_class"])])
    classes = [name for name in present if any(name in split["per_class"] for split in splits)]
    found = provenance()
    commit = {"commit": found["git_commit"]} if found["git_commit"] else {}
    files = _files(output, scenes, fits)
    return fill_template(
        output / "index.html",
        "demo.html.j2",
        filters={"data_uri": _data_uri, "duration": _duration},
        title="RayTran on generated rooms",
        summary="Rooms were generated, a small network was trained from scratch through the three stages of "
        f"the paper, and then asked for the objects of the {_scenes(metrics, 'train')} training rooms and of "
        f"{_scenes(metrics, 'val')} held-out ones: class, position, size, heading and mesh, from posed "
        f"frames alone, {_frames(metrics)} of each room. From other frames, or from more of them, the "
        "numbers are others.",
        splits=splits,
        sections=[*(_room(scene, output) for scene in scenes), _training(output, fits)],
        view=f"raytran view {shlex.quote(str(output / 'predictions'))}",
        classes=[(name, colors.get(name, INK)) for name in classes],
        seconds=seconds,
        files={name: _relative(path, output) for name, path in files.items()},
        versions={**found["versions"], **commit, "platform": found["platform"]},
    )


def _scenes(metrics: Mapping[str, Mapping[str, Any]], column: str) -> int:
    return metrics[column]["strict"]["n_scenes"]


def _frames(metrics: Mapping[str, Mapping[str, Any]]) -> str:
    """Return how many frames of a room the networks were given; all columns have the same number."""
    return " or ".join(
        str(count) for count in dict.fromkeys(entry["num_views"] for entry in metrics.values())
    )


def _split(column: str, metrics: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the scores on one set of rooms, and what they prove and what they do not."""
    meaning = {
        "train": "The network was trained on these very rooms. High numbers prove that the whole chain "
        "learns, from pixels to boxes and meshes; they say nothing about other rooms.",
        "val": "The network has never seen these rooms. So few training rooms (here "
        f"{_scenes(metrics, 'train')}) cannot teach what furniture looks like in general, so low numbers are "
        "expected; many more are needed for that.",
        "shipped": "The same held-out rooms, asked of the weights that come with raytran. They learned from "
        f"a thousand other rooms on two CPU cores; {page('results.md')} tells what to expect of them.",
    }
    per_class = metrics[column]["strict"]["per_class"]
    return {
        "title": COLUMNS[column].capitalize(),
        "meaning": meaning[column],
        "numbers": headline(metrics[column]),
        "per_class": {
            name: (entry["n_good"], entry["n_total"]) for name, entry in per_class.items() if entry["n_total"]
        },
    }


def _training(output: Path, fits: Sequence[FitResult]) -> dict[str, Any]:
    """Return the section with the loss curves."""
    histories = {_STAGES.get(fit.folder.name, fit.folder.name): read_history(fit.folder) for fit in fits}
    steps = ", ".join(f"{fit.steps:,}" for fit in fits)
    curves = draw_curves(output / "pictures" / "curves.png", histories)
    return {
        "title": "Training",
        "text": f"Three fits, one after another, of {steps} steps, each until the training rooms are learned "
        "or its steps used up: first what is occupied, then everything but the shapes, then the shapes alone "
        "while the rest is frozen.",
        "links": [],
        "pictures": [
            _plot(curves, "Terms of the loss against steps: running mean and single values.", wide=True)
        ],
    }


def _room(scene: ShownScene, output: Path) -> dict[str, Any]:
    """Return the section of a room: what ``write_scene`` drew, and the network's input and output."""
    batch, prediction = scene.batch, scene.prediction
    folder = output / "pictures" / scene.column
    folder.mkdir(parents=True, exist_ok=True)
    in_order = dict.fromkeys(scene.folder / "overlays" / f"{name}.jpg" for name in batch.frame_id[0])
    overlays = [
        Image.fromarray(decode_image(path, name=str(path)).permute(1, 2, 0).numpy())
        for path in in_order
        if path.is_file()
    ]
    shown = [
        _plot(
            scene.folder / "topdown.png", "From above. Filled: predicted; dashed: true; arrow heads: fronts."
        ),
        _picture(
            contact_sheet(folder / "overlays.jpg", overlays, columns=2),
            "Predicted boxes and meshes over frames; the front face of a box is drawn bold.",
        ),
        _picture(
            draw_frames(folder / "frames.jpg", batch.views),
            "Some of the frames the network was given.",
            wide=True,
        ),
    ]
    if prediction.foreground is not None:
        truth = None if batch.foreground is None else batch.foreground[0]
        masks = draw_masks(folder / "masks.jpg", batch.views, prediction.foreground, truth, columns=2)
        caption = "Where objects are, also where others hide them. Orange: predicted; white line: true."
        shown.append(_picture(masks, caption))
    if prediction.occupancy is not None:
        truth = None if batch.occupancy is None else batch.occupancy[0]
        height = scene.grid_extent[2]
        slices = draw_occupancy(folder / "occupancy.png", prediction.occupancy, truth, height=height)
        shown.append(_plot(slices, "Occupied voxels in four layers; heights count from the mean camera."))
    count = 0 if batch.objects is None else len(batch.objects[0])
    kind = "training" if scene.column == "train" else "held-out"
    by = ", by raytran's own weights" if scene.column == "shipped" else ""
    return {
        "title": f"A {kind} room{by}: {prediction.scene_id}",
        "text": f"{_were(len(prediction.objects))} predicted, {count} {'is' if count == 1 else 'are'} there.",
        "pictures": shown,
        "links": [
            (text, _relative(scene.folder / name, output))
            for name, text in _TO_LOOK_AT.items()
            if (scene.folder / name).is_file()
        ],
    }


def _were(count: int) -> str:
    return "1 object was" if count == 1 else f"{count} objects were"


def _picture(path: Path, caption: str, *, wide: bool = False) -> dict[str, Any]:
    return {"path": path, "caption": caption, "wide": wide, "plot": False}


def _plot(path: Path, caption: str, *, wide: bool = False) -> dict[str, Any]:
    """Return a picture with text on white paper, which is not to shrink and in the dark not to shine."""
    return _picture(path, caption, wide=wide) | {"plot": True}


def _relative(path: Path, output: Path) -> str:
    return Path(os.path.relpath(path, output)).as_posix()


def _files(output: Path, scenes: Sequence[ShownScene], fits: Sequence[FitResult]) -> dict[str, Path]:
    """Return what each file or folder holds → its path."""
    files = {f"3D scene of {scene.folder.name} (glTF)": scene.folder / "scene.glb" for scene in scenes}
    files |= {f"meshes of {scene.folder.name} (PLY)": scene.folder / "meshes" for scene in scenes}
    files["numbers by room and by object"] = output / "evaluation"
    files["trained network"] = fits[-1].checkpoint
    files["the rooms"] = output / "rooms"
    return files


def _data_uri(path: Path) -> str:
    return data_uri(path.read_bytes(), _MEDIA[path.suffix])


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"
