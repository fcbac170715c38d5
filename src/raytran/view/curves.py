# SPDX-License-Identifier: Apache-2.0
"""Loss curves from the ``metrics.csv`` of each fit."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from raytran.errors import DataError
from raytran.view.palette import FAINT, INK

Curves = dict[str, tuple[list[int], list[float]]]
"""Column name → optimiser steps and values."""


def read_curves(path: Path) -> Curves:
    """Read the columns of a ``metrics.csv`` as Lightning's ``CSVLogger`` writes it, empty cells left out.

    Raises:
        DataError: the file is missing or holds something that is not a number.
    """
    curves: Curves = defaultdict(lambda: ([], []))
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                for name, cell in row.items():
                    if name not in ("step", "epoch") and cell:
                        curves[name][0].append(int(float(row["step"])))
                        curves[name][1].append(float(cell))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"cannot read loss curves from {path} ({error}); train that stage again") from error
    return dict(curves)


def draw_curves(path: Path, stages: Mapping[str, Curves], *, prefix: str = "train/") -> Path:
    """Draw the terms of the loss, one plot per stage, on a logarithmic scale.

    Args:
        path: PNG file.
        stages: name of each stage, in order → its curves.
        prefix: what the names of the curves to draw begin with; the rest of a name is its label. Names with a
            ``layer`` part, the losses at the decoder's earlier layers, are left out.
    """
    figure = Figure(
        figsize=(4.4 * max(len(stages), 1), 3.6), dpi=120, layout="constrained", facecolor="white"
    )
    plots = figure.subplots(1, max(len(stages), 1), squeeze=False)[0]
    for axes, (stage, curves) in zip(plots, stages.items(), strict=False):
        for name in sorted(curves):
            label = name.removeprefix(prefix)
            if name == label or "layer" in label:
                continue
            steps, values = curves[name]
            total = label == "total"
            axes.plot(
                steps, values, label=label, color=INK if total else None, linewidth=2.0 if total else 1.2
            )
        axes.set_yscale("log")
        axes.set_title(stage, loc="left", color=INK, fontsize=11)
        axes.set_xlabel("step", color=INK)
        axes.tick_params(colors=FAINT, labelsize=8, which="both")
        axes.grid(color="#e6e9ee", linewidth=0.6)
        axes.spines[:].set_color("#c9cfd8")
        if axes.lines:
            axes.legend(frameon=False, fontsize=8, labelcolor=INK)
    figure.savefig(path)
    return path
