# SPDX-License-Identifier: Apache-2.0
"""The scores of predictions as tables for the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table

from raytran.run.evaluate.protocols import PROTOCOLS

_PLAIN: dict[str, Any] = {"box": box.SIMPLE_HEAD, "pad_edge": False, "collapse_padding": True}
_CAPTION = escape("[low–high]: 95 % of bootstrap draws of the scenes")
_AVERAGES = {"class_average": "mean of classes", "global_average": "all objects"}
_DETECTION = {
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
    "average_precision": "AP",
}


def scores_table(metrics: Mapping[str, Any], *, title: str) -> Table:
    """Return the protocols side by side.

    Args:
        metrics: content of ``metrics.json``.
        title: what was scored.
    """
    names = [name for name in PROTOCOLS if name in metrics]
    parts = [metrics[name] for name in names]
    table = Table("", *names, title=escape(title), caption=_CAPTION, **_PLAIN)
    table.add_row("scenes", *(str(part["n_scenes"]) for part in parts))
    table.add_section()
    classes = dict.fromkeys(
        name for part in parts for name, row in part.get("per_class", {}).items() if row.get("n_total")
    )
    for category in classes:
        table.add_row(category, *(_class_cell(part, category) for part in parts))
    table.add_section()
    for number, label in _AVERAGES.items():
        table.add_row(label, *(_percent(part, number) for part in parts))
    table.add_section()
    thresholds = dict.fromkeys(name for part in parts for name in part.get("per_threshold", {}))
    for threshold in thresholds:
        for number, label in _DETECTION.items():
            cells = [_threshold_cell(part, threshold, number) for part in parts]
            if any(cells):
                table.add_row(f"{label} @ {threshold}", *cells)
    return table


def _class_cell(part: Mapping[str, Any], category: str) -> str:
    entry = part.get("per_class", {}).get(category, {})
    if not entry.get("n_total"):
        return ""
    return f"{entry['n_good']}/{entry['n_total']} {entry['accuracy']:.1%}"


def _percent(part: Mapping[str, Any], number: str) -> str:
    return f"{part[number]:.1%} {_interval(part, number)}" if number in part else ""


def _threshold_cell(part: Mapping[str, Any], threshold: str, number: str) -> str:
    entry = part.get("per_threshold", {}).get(threshold, {})
    if number not in entry:
        return ""
    interval = _interval(part, f"f1_{threshold}") if number == "f1" else ""
    return f"{entry[number]:.1%} {interval}".rstrip()


def _interval(part: Mapping[str, Any], number: str) -> str:
    bounds = part["confidence"].get(number)
    return "" if bounds is None else escape(f"[{100 * bounds['low']:.1f}–{100 * bounds['high']:.1f}]")


def atlas_table(atlas: Mapping[str, Any]) -> Table:
    """Return why objects were missed under protocol ``strict``, by class, with the causes that occur."""
    causes = [cause for cause, count in atlas["objects"].items() if count]
    table = Table("class", *causes, title="error atlas (strict)", **_PLAIN)
    for category, counts in atlas["per_class"].items():
        if any(counts.values()):
            table.add_row(category, *(str(counts[cause]) for cause in causes))
    table.add_section()
    table.add_row("all", *(str(atlas["objects"][cause]) for cause in causes))
    return table


def comparison_table(comparison: Mapping[str, Any], first: str, second: str) -> Table:
    """Return the differences of two sets of predictions on the scenes that count for both."""
    columns = ("protocol", "", "first", "second", "difference", "p")
    table = Table(*columns, title=escape(f"first: {first}, second: {second}"), **_PLAIN)
    table.caption = "p: permutation test over scenes, * below 0.05"
    for row in _comparison_rows(comparison):
        table.add_row(*row)
    return table


def _comparison_rows(comparison: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for protocol, numbers in comparison.items():
        for number, entry in numbers.items():
            yield (
                protocol,
                _AVERAGES.get(number, number.replace("f1_", "F1 @ ")),
                *(f"{entry[side]:.1%}" for side in ("first", "second")),
                f"{entry['difference']:+.1%} "
                + escape(f"[{100 * entry['low']:+.1f}, {100 * entry['high']:+.1f}]"),
                f"{entry['p_value']:.3f}" + (" *" if entry["significant"] else ""),
            )
