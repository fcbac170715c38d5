# SPDX-License-Identifier: Apache-2.0
"""Loss curves of the fits of a curriculum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from raytran.pictures.palette import FAINT, INK

History = Mapping[str, Sequence[tuple[int, float]]]
"""Name of a logged value → (optimiser step, value) pairs by rising step."""

_SMOOTHED = 12
"""Steps logged on which a running mean is taken, at most; each scene's loss has a level of its own."""


def draw_curves(path: Path, stages: Mapping[str, History], *, prefix: str = "train/") -> Path:
    """Draw the terms of the loss, one plot per stage, on a logarithmic scale.

    A line is the running mean of a term's values, which lie faintly behind.

    Args:
        path: PNG file.
        stages: name of each stage, in order → what it logged.
        prefix: what the names of values to draw begin with; the rest of a name is its label. The losses at
            the decoder's earlier layers (a part of the name begins with ``layer``) are left out.
    """
    columns = max(len(stages), 1)
    figure = Figure(figsize=(4.4 * columns, 3.8), dpi=120, layout="constrained", facecolor="white")
    plots = figure.subplots(1, columns, squeeze=False)[0]
    for axes, (stage, history) in zip(plots, stages.items(), strict=False):
        terms = [name.removeprefix(prefix) for name in sorted(history) if name.startswith(prefix)]
        terms = [term for term in terms if "/layer" not in term]
        # One term alone is the total.
        for term in terms if len(terms) > 2 else [term for term in terms if term == "total"]:
            _draw_term(axes, term, history[prefix + term])
        axes.set_yscale("log")
        axes.set_title(stage, loc="left", color=INK, fontsize=11)
        axes.set_xlabel("step", color=INK)
        axes.tick_params(colors=FAINT, labelsize=8, which="both")
        axes.grid(color="#e6e9ee", linewidth=0.6)
        axes.spines[:].set_color("#c9cfd8")
        if axes.lines:
            below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "ncols": 3}
            axes.legend(frameon=False, fontsize=8, labelcolor=INK, **below)
    figure.savefig(path)
    return path


def running_mean(pairs: Sequence[tuple[int, float]]) -> list[tuple[int, float]]:
    """Return means over the last few logged values, at the step of the last; few values stay as they are."""
    steps, values = np.array(pairs).T
    window = max(1, min(_SMOOTHED, len(values) // 8))
    smooth = np.convolve(values, np.ones(window) / window, mode="valid")
    return list(zip(steps[window - 1 :].tolist(), smooth.tolist(), strict=True))


def _draw_term(axes: Axes, term: str, pairs: Sequence[tuple[int, float]]) -> None:
    steps, values = np.array(pairs).T
    smooth = running_mean(pairs)
    total = term == "total"
    (line,) = axes.plot(
        *np.array(smooth).T, label=term, color=INK if total else None, linewidth=2.0 if total else 1.3
    )
    if len(smooth) < len(values):
        axes.plot(steps, values, color=line.get_color(), linewidth=0.6, alpha=0.18)
