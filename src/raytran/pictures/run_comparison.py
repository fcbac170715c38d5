# SPDX-License-Identifier: Apache-2.0
"""One self-contained HTML page that lays training runs side by side; no scripts, no other files."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from raytran.pictures.curves import History, running_mean
from raytran.pictures.page import data_uri, write_page
from raytran.pictures.palette import FAINT

_COLORS = (
    *("#1f6fb2", "#d9731a", "#2b8a4b", "#a43fb0", "#c62f2f"),
    *("#0f8b8d", "#8c6d1f", "#5b5bd6", "#d14b8f", "#5b6676"),
)
_DASHES = ("-", (0, (4, 1.5)), (0, (1.2, 1.2)))

_GROUPS: dict[str, tuple[tuple[str, ...], bool | None]] = {
    "Scores on the validation scenes": (("val/",), True),
    "Losses in training": (("train/",), False),
    "Losses on the validation scenes": (("val/",), False),
    "Health": (("health/",), None),
    "Time and memory": (("time/", "memory/", "schedule/"), None),
}
"""Heading → what the names of its values begin with, and whether they are scores."""

_LOSS_TERMS = ("total", "occupancy", "foreground", "shape", "class", "center", "size", "yaw")


@dataclass(frozen=True)
class RunRecord:
    """What is known of a run.

    Attributes:
        name: to tell it from the others.
        history: what it logged.
        settings: name of each setting, with dots → its value.
        facts: what to say of it: stage, steps, time, machine, …; the same names for all runs.
    """

    name: str
    history: History
    settings: Mapping[str, object]
    facts: Mapping[str, str]


@dataclass(frozen=True)
class _Number:
    text: str
    best: bool


@dataclass(frozen=True)
class _Row:
    name: str
    cells: Sequence[_Number]


def write_run_comparison(path: Path, runs: Sequence[RunRecord], *, notes: Sequence[str] = ()) -> Path:
    """Write the page; it appears whole or not at all.

    Args:
        path: HTML file.
        runs: to compare, at least one.
        notes: sentences to put above everything, e.g. what was left out.

    Returns:
        ``path``.
    """
    names = sorted({name for run in runs for name in run.history}, key=_place)
    per_class = [name for name in names if _is_score(name) and name.count("/") == 3]
    overall = [name for name in names if _is_score(name) and name not in per_class]
    differing, same = _settings(runs)
    return write_page(
        path,
        "runs.html.j2",
        title=runs[0].name if len(runs) == 1 else f"{len(runs)} runs compared",
        runs=[(run, _COLORS[i % len(_COLORS)]) for i, run in enumerate(runs)],
        notes=notes,
        facts=list(dict.fromkeys(fact for run in runs for fact in run.facts)),
        scores=[_row(name, runs, max) for name in overall],
        losses=[_row(name, runs, min) for name in names if name.startswith("val/") and not _is_score(name)],
        per_class=[_row(name, runs, max) for name in per_class],
        differing=differing,
        same=same,
        charts=[(title, _charts(title, names, runs)) for title in _GROUPS],
    )


def final(history: History, name: str) -> float | None:
    """Return the last value logged under a name."""
    pairs = history.get(name)
    return pairs[-1][1] if pairs else None


def _place(name: str) -> tuple[int, str]:
    """Return a sort key: objects before the tasks that help to find them."""
    tasks = ("objects", "occupancy", "foreground")
    task = name.split("/")[1] if "/" in name else ""
    return (tasks.index(task) if task in tasks else len(tasks), name)


def _is_score(name: str) -> bool:
    """Say whether a value is one of the validation's scores, of which more is better."""
    return name.startswith("val/") and name.split("/")[-1] not in _LOSS_TERMS and "/layer" not in name


def _row(name: str, runs: Sequence[RunRecord], best: Callable[[Sequence[float]], float]) -> _Row:
    values = [final(run.history, name) for run in runs]
    finite = [value for value in values if value is not None and math.isfinite(value)]
    # Best of one, or of equals, is no news.
    winner = best(finite) if len(finite) > 1 and min(finite) < max(finite) else None
    cells = [_Number("–" if v is None else _text(v), winner is not None and v == winner) for v in values]
    return _Row(name.removeprefix("val/"), cells)


def _text(value: float) -> str:
    return f"{value:.3f}" if 0.001 <= abs(value) < 1000 or value == 0 else f"{value:.3g}"


def _settings(runs: Sequence[RunRecord]) -> tuple[list[tuple[str, list[str]]], int]:
    """Return the settings that are not the same in all runs, and the number of those that are."""
    names = sorted({name for run in runs for name in run.settings})
    missing = object()
    differing, same = [], 0
    for name in names:
        values = [run.settings.get(name, missing) for run in runs]
        if all(value == values[0] for value in values):
            same += 1
        else:
            differing.append((name, ["not set" if value is missing else str(value) for value in values]))
    return differing, same


def _charts(title: str, names: Sequence[str], runs: Sequence[RunRecord]) -> list[tuple[str, str]]:
    """Return label and image, as a data URI, of each chart of a group."""
    prefix, scores = _GROUPS[title]
    chosen = [name for name in names if name.startswith(prefix) and "/layer" not in name]
    if scores is not None:
        chosen = [name for name in chosen if _is_score(name) == scores and name.count("/") < 3]
    chosen.sort(key=lambda name: name.split("/")[-1] not in ("total", "all"))
    return [(name, _chart(name, runs, smooth=not scores)) for name in chosen]


def _chart(name: str, runs: Sequence[RunRecord], *, smooth: bool) -> str:
    # Small and sharp at any size; text stays text, in the reader's own typeface.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "raytran", "font.family": "sans-serif"}):
        figure = Figure(figsize=(3.4, 2.1), layout="constrained")
        axes = figure.add_subplot()
        lowest = math.inf
        for i, run in enumerate(runs):
            if pairs := [pair for pair in run.history.get(name, ()) if math.isfinite(pair[1])]:
                _draw(axes, pairs, i, smooth=smooth)
                lowest = min([lowest, *(value for _, value in pairs)])
        if name.startswith("train/") and lowest > 0:
            axes.set_yscale("log")
        elif lowest >= 0 and (_is_score(name) or name.startswith("health/")):
            # From zero, so that heights mean something; the line of a score of zero stays visible.
            top = axes.get_ylim()[1] if lowest < math.inf else 1.0
            axes.set_ylim(-0.03 * top, max(top, 0.1))
        axes.set_xlabel("step", color=FAINT, fontsize=8)
        axes.margins(x=0.02)
        axes.tick_params(colors=FAINT, labelsize=8, which="both")
        axes.grid(color=FAINT, alpha=0.25, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[:].set_color(FAINT)
        target = BytesIO()
        figure.savefig(target, format="svg", transparent=True, metadata={"Date": None})
    return data_uri(target.getvalue(), "image/svg+xml")


def _draw(axes: Axes, pairs: Sequence[tuple[int, float]], index: int, *, smooth: bool) -> None:
    color, dashes = _COLORS[index % len(_COLORS)], _DASHES[index // len(_COLORS) % len(_DASHES)]
    means = running_mean(pairs) if smooth else list(pairs)
    if len(means) < len(pairs):
        axes.plot(*zip(*pairs, strict=True), color=color, linewidth=0.6, alpha=0.2)
    marker = "o" if len(means) < 12 else None
    axes.plot(
        *zip(*means, strict=True), color=color, linestyle=dashes, linewidth=1.6, marker=marker, markersize=3.5
    )
