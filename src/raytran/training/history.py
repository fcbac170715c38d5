# SPDX-License-Identifier: Apache-2.0
"""What a run has logged, read back from its ``metrics.csv``; Lightning is not needed for it."""

from __future__ import annotations

import csv
import logging
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from raytran.limits import MAX_STEPS

_log = logging.getLogger(__name__)

METRICS = "metrics.csv"

_WITHOUT_COLUMN = ""
_TAIL = 1 << 18
"""Bytes at the end of a table in which the newest values are looked for."""


def read_table(path: Path) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the columns and rows of a run's table, as far as they are whole; nothing if there is none.

    Left out are a last line that a kill cut short, a row without a step, and values without a column, which
    earlier versions wrote on a disk that had been full.
    """
    return _parsed(path.read_text(encoding="utf-8", errors="replace")) if path.is_file() else ([], [])


def _parsed(text: str) -> tuple[list[str], list[dict[str, Any]]]:
    """Return columns and rows of the text of a table."""
    lines = [line for line in text.splitlines(keepends=True) if line.endswith("\n") and "\0" not in line]
    table = csv.DictReader(lines, restkey=_WITHOUT_COLUMN)
    columns = list(table.fieldnames or ())
    rows = [{name: row[name] for name in columns} for row in _rows(table)]
    return columns, [row for row in rows if step_of(row) is not None]


def _rows(table: csv.DictReader[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table up to a damage: they are for pictures, and no run should end for one."""
    try:
        yield from table
    except csv.Error as error:
        _log.warning("the rest of the logged values is not read: %s", error)


def step_of(row: Mapping[str, Any]) -> int | None:
    """Return the step of a row, None if it is damaged."""
    step = as_number(row.get("step"))
    return int(step) if step is not None and 0 <= step <= MAX_STEPS else None


def as_number(cell: Any) -> float | None:
    """Return the number in a cell, None if there is none; a loss may be infinite."""
    try:
        return float(cell)
    except (TypeError, ValueError):
        return None


def read_history(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return what a run logged: name → (step, value) pairs by rising step.

    Args:
        folder: of the run.
    """
    history: dict[str, dict[int, float]] = {}
    for row in read_table(folder / METRICS)[1]:
        for name, value in row.items():
            number = as_number(value)
            if name not in ("step", "epoch") and number is not None:
                history.setdefault(name, {})[int(row["step"])] = number
    return {name: sorted(values.items()) for name, values in history.items()}


def newest_values(folder: Path, names: Collection[str]) -> tuple[int, dict[str, float]]:
    """Return how many steps a run has logged, 0 if none, and the newest value of each metric that it has.

    However long the run, only the end of its table is read: a score from long before is not found.

    Args:
        folder: of the run.
        names: metrics, e.g. ``train/total``.
    """
    path = folder / METRICS
    try:
        with path.open("rb") as file:
            header = file.readline()
            begin = max(len(header), path.stat().st_size - _TAIL)
            file.seek(begin)
            if begin > len(header):
                file.readline()  # the rest of a row
            text = (header + file.read()).decode("utf-8", errors="replace")
    except OSError:
        return 0, {}
    steps, values = 0, dict[str, float]()
    for row in _parsed(text)[1]:
        steps = max(steps, int(row["step"]) + 1)
        found = {name: as_number(row.get(name)) for name in names}
        values |= {name: value for name, value in found.items() if value is not None}
    return steps, values
