# SPDX-License-Identifier: Apache-2.0
"""How often predictions of a score are right: whether scores mean what they say."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from raytran.pictures.palette import FAINT, INK

FILE = "reliability.png"

_BAR = "#1f5fbf"


def draw_reliability(path: Path, calibration: Mapping[str, Any]) -> Path:
    """Write ``reliability_figure`` to a PNG file and return it."""
    reliability_figure(calibration).savefig(path)
    return path


def reliability_figure(calibration: Mapping[str, Any]) -> Figure:
    """Draw the share of right boxes against the score; on the dotted line scores mean what they say.

    A number stands on each bar: of how many predictions it is.

    Args:
        calibration: what ``ScoreCalibration.compute`` returned.
    """
    figure = Figure(figsize=(4.8, 4.4), dpi=120, layout="constrained", facecolor="white")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], ":", color=INK, linewidth=1.2)
    for part in calibration["bins"]:
        if part["n_predicted"]:
            middle, width = (part["low"] + part["high"]) / 2, part["high"] - part["low"]
            axes.bar(middle, part["share_right"], width=0.9 * width, color=_BAR, alpha=0.75)
            at = min(part["share_right"] + 0.01, 0.96)
            axes.text(middle, at, str(part["n_predicted"]), ha="center", color=INK, fontsize=7)
    error = calibration["expected_error"]
    said = "no prediction" if error is None else f"expected calibration error {error:.3f}"
    axes.set_title(said, color=INK, fontsize=10)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    axes.set_xlabel("score", color=INK)
    axes.set_ylabel("boxes that are right, IoU above 0.25", color=INK)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.tick_params(colors=FAINT, labelsize=8)
    axes.spines[:].set_color("#c9cfd8")
    return figure
