# SPDX-License-Identifier: Apache-2.0
"""Accuracy against the thresholds (RayTran, figure 4): how far off the objects are that are found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from raytran.pictures.palette import FAINT, INK

FILE = "accuracy_curves.png"

_PANELS = (
    ("translation", "translation error below, cm", 100.0, 20.0),
    ("rotation", "rotation error below, degrees", 1.0, 20.0),
    ("scale", "scale error below, %", 100.0, 20.0),
    ("joint", "all three below, times these limits", 1.0, 1.0),
)
"""Curve, its axis, by what its thresholds are multiplied, and the benchmark's limit on that axis."""

_COLORS = ("#1f5fbf", "#d1495b", "#2a9d6f", "#e09f3e", "#7a4fb5", "#5c6670")
_STYLES = ("-", "--", "-.")


def draw_accuracy_curves(path: Path, results: Mapping[str, Mapping[str, Any]]) -> Path:
    """Write ``accuracy_figure`` to a PNG file and return it."""
    accuracy_figure(results).savefig(path)
    return path


def accuracy_figure(results: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw the accuracy of one or several results against each threshold, the other two left out of account.

    A line is the mean of the classes, as in the paper; of a single result the share of all objects is there
    too. A dotted line marks the limit of the benchmark, and the dot on it what a table of results says. The
    last plot varies the three thresholds together, so that its dot is the accuracy of the benchmark.

    Args:
        results: what ``AccuracyCurves.compute`` returned, by the name of the result, at least one.
    """
    figure = Figure(figsize=(13.2, 4.0), dpi=120, layout="constrained", facecolor="white")
    plots = figure.subplots(1, len(_PANELS), sharey=True)
    for axes, (curve, label, unit, limit) in zip(plots, _PANELS, strict=True):
        _draw_limit(axes, limit, label)
        for index, (name, curves) in enumerate(results.items()):
            color = _COLORS[index % len(_COLORS)]
            style = _STYLES[index // len(_COLORS) % len(_STYLES)]
            at = [unit * threshold for threshold in curves[curve]["threshold"]]
            average = curves[curve]["class_average"]
            said = name if len(results) > 1 else "mean of classes"
            axes.plot(at, average, style, color=color, linewidth=2.0, label=said)
            axes.plot([limit], [average[_nearest(at, limit)]], "o", color=color, markersize=5, clip_on=False)
            if len(results) == 1:
                every = curves[curve]["global_average"]
                axes.plot(at, every, "--", color=FAINT, linewidth=1.4, label="all objects", zorder=1)
    plots[0].set_ylabel("accuracy, mean of classes" if len(results) > 1 else "accuracy", color=INK)
    highest = max(line.get_ydata().max() for axes in plots for line in axes.get_lines()[1:])
    plots[0].set_ylim(0, max(0.2, math.ceil(5 * highest) / 5))
    handles, labels = plots[0].get_legend_handles_labels()
    look: dict[str, Any] = {"frameon": False, "fontsize": 9, "labelcolor": INK, "ncols": min(len(labels), 4)}
    figure.legend(handles, labels, loc="outside lower center", **look)
    return figure


def _nearest(values: list[float], wanted: float) -> int:
    return min(range(len(values)), key=lambda index: abs(values[index] - wanted))


def _draw_limit(axes: Axes, limit: float, label: str) -> None:
    """Set up one plot, with the limit of the benchmark in it."""
    axes.axvline(limit, color=INK, linestyle=":", linewidth=1.2, zorder=1)
    axes.set_xlim(0, 3 * limit)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.set_xlabel(label, color=INK)
    axes.tick_params(colors=FAINT, labelsize=8)
    axes.grid(color="#e6e9ee", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[:].set_color("#c9cfd8")
