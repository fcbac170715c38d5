# SPDX-License-Identifier: Apache-2.0
"""Draws the folders of ``src/raytran`` for docs/architecture.md: ``python docs/architecture.py``.

A test holds them against the layers that tests/test_layers.py enforces, and the picture against this file.
"""

from __future__ import annotations

import json
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

PICTURE = Path(__file__).with_suffix(".png")

COLUMNS: tuple[dict[str, str], ...] = (
    {"errors": "one sentence\neach"},
    {"limits": "what numbers\ncan mean", "tensor_archive": "files of torch.save,\nuntrusted"},
    {"classes": "names, colours,\ncategories", "setting_limits": "what settings\ncan mean"},
    {"structs": "batch, output,\nprediction"},
    {"geometry": "cameras, boxes,\nvoxel grid"},
    {"ops": "rays, pairs,\nsparse attention", "norms": "batch and layer\nnorms"},
    {"backbone": "images → voxels", "heads": "voxels → answers"},
    {"model": "RayTran"},
    {"losses": "matching, terms", "metrics": "scores", "data": "files → batch", "postprocess": "what counts"},
    {"extensions": "what goes beyond\nthe paper"},
    {"pictures": "overlays, plans"},
    {"checkpoints": "weights and what\nthey are"},
    {"export": "GLB, OBJ, CSV,\nprograms", "training": "Lightning:\nstages, callbacks"},
    {"run": "configs →\nobjects"},
    dict.fromkeys(
        (
            "train",
            "curriculum",
            "evaluate",
            "predict",
            "prepare",
            "plan",
            "demo",
            "view",
            "poses",
            "export_model",
        ),
        "",
    ),
)
"""Folders and files from left to right, each with what it holds; the last column are the commands."""

WINGS = {
    "rooms": "generated rooms\nand furniture",
    "capture": "recordings of any\nkind, the doctor",
    "viewer": "the browser",
}
"""Imported by ``run`` alone."""

METHOD = {"geometry", "ops", "backbone", "heads", "model", "losses", "extensions"}
"""What is RayTran: the rest brings it data, trains it, and shows what it finds."""

_STEP, _WIDTH, _HEIGHT = 1.5, 1.3, 0.62
_METHOD, _OTHER, _WING = "#cfe3f5", "#eeeeee", "#f7e6c4"


def content() -> dict[str, list[list[str]]]:
    """Return the names in the picture: columns from left to right, and wings."""
    return {"columns": [list(column) for column in COLUMNS], "wings": [list(WINGS)]}


def draw() -> Figure:
    """Return the picture."""
    width, height = _STEP * len(COLUMNS), 4.75
    figure = Figure(figsize=(width * 0.82, height * 0.82))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set(xlim=(-0.15, width), ylim=(-1.35, height - 1.35))
    middle = 1.6
    run_place = 0.0
    for number, column in enumerate(COLUMNS):
        left = number * _STEP
        step = _HEIGHT * (0.62 if len(column) > 4 else 1.25)
        top = middle + step * (len(column) - 1) / 2
        for row, (name, what) in enumerate(column.items()):
            _box(axes, left, top - row * step, name, what, _METHOD if name in METHOD else _OTHER)
        if number:
            _arrow(axes, (left, middle), (left - _STEP + _WIDTH, middle))
        run_place = left if "run" in column else run_place
    bottom = -0.9
    for number, (name, what) in enumerate(WINGS.items()):
        left = run_place - (2 - number) * _STEP
        _box(axes, left, bottom, name, what, _WING)
        _arrow(
            axes, (run_place + _WIDTH / 2, middle - _HEIGHT / 2), (left + _WIDTH / 2, bottom + _HEIGHT / 2)
        )
    axes.text(
        0,
        -0.75,
        "an arrow points to what may be imported: what stands further left; run also imports the wings",
        fontsize=9,
    )
    axes.text(0, -1.1, "blue: the method    yellow: wings, which run alone imports", fontsize=9)
    return figure


def _box(axes: Axes, left: float, middle: float, name: str, what: str, color: str) -> None:
    height = _HEIGHT if what else _HEIGHT * 0.5
    corner = (left, middle - height / 2)
    style = "round,pad=0,rounding_size=0.06"
    axes.add_patch(
        FancyBboxPatch(corner, _WIDTH, height, boxstyle=style, facecolor=color, edgecolor="#888888")
    )
    lift = 0.15 if "\n" in what else 0.1 if what else 0
    axes.text(left + _WIDTH / 2, middle + lift, name, ha="center", va="center", fontsize=9, weight="bold")
    axes.text(left + _WIDTH / 2, middle - 0.12, what, ha="center", va="center", fontsize=6.5, linespacing=1.0)


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=8, color="#888888", zorder=0))


def main() -> None:
    """Write the picture; the names in it go along as a text of the PNG."""
    draw().savefig(PICTURE, dpi=110, metadata={"Description": json.dumps(content())})


if __name__ == "__main__":
    main()
