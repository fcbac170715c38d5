# SPDX-License-Identifier: Apache-2.0
"""The rows that ``real.py`` keeps: a CSV file with one row a network, and a page that shows them."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from raytran.data.files import whole_file, write_text

Cells = Mapping[str, str | int | float | None]
"""One row; None, or nothing, is a figure that was not taken."""

KEY = ("sha256", "num_views", "score_threshold", "scenes")
"""What tells one row from another: the weights, and how they were asked."""

HOW = ("name", *KEY, "date", "commit")


@dataclass(frozen=True)
class Column:
    """One figure.

    Attributes:
        name: its column in the CSV file, the case that it is of before the first underline.
        title: above its column on the page.
        form: of the number on the page, as of ``format``.
        per: what it is multiplied with there.
    """

    name: str
    title: str
    form: str = "{:.0f}"
    per: float = 1.0


@dataclass(frozen=True)
class Case:
    """What networks are tried on.

    Attributes:
        name: short.
        title: in a sentence, for the page.
        columns: its figures.
    """

    name: str
    title: str
    columns: tuple[Column, ...]


def _accuracy(case: str) -> tuple[Column, ...]:
    return (
        Column(f"{case}_accuracy", "accuracy", "{:.1f} %", 100),
        Column(f"{case}_f1", "F1@0.25", "{:.3f}"),
        Column(f"{case}_predicted", "predicted"),
    )


CASES = (
    Case(
        "rooms",
        "(a) rooms-v1 test, whose objects the training's generator drew; shapes are those of right objects",
        (
            *_accuracy("rooms"),
            Column("rooms_true", "true"),
            Column("rooms_shape_iou", "shape IoU", "{:.3f}"),
            Column("rooms_chamfer_m", "chamfer", "{:.1f} cm", 100),
            Column("rooms_chair_iou", "of chairs", "{:.3f}"),
            Column("rooms_chair_chamfer_m", "chamfer of chairs", "{:.1f} cm", 100),
        ),
    ),
    Case(
        "furniture",
        "(b) rooms with furniture by other people, that no training room has; generated pieces fill up",
        (
            *_accuracy("furniture"),
            Column("furniture_given_accuracy", "accuracy of given pieces", "{:.1f} %", 100),
            Column("furniture_true", "true"),
            Column("furniture_calibration", "calibration error, counted", "{:.3f}"),
            Column("furniture_calibration_every", "of every score", "{:.3f}"),
        ),
    ),
    Case(
        "scan",
        "(c) a real scan with true CAD alignments",
        (
            *_accuracy("scan"),
            Column("scan_true", "true"),
            Column("scan_in_nothing", "predicted where there is no true box"),
        ),
    ),
    Case(
        "lounge",
        "(d) a real lounge, of which some large pieces are annotated",
        (
            Column("lounge_right", "right class, centre within 40 cm"),
            Column("lounge_true", "annotated"),
            Column("lounge_predicted", "predicted"),
        ),
    ),
)

COLUMNS = (*HOW, *(column.name for case in CASES for column in case.columns))


def keep_row(path: Path, row: Cells) -> list[str]:
    """Put a row into a CSV file, in place of the one with the same key; write the page beside it.

    Cases that the row has no figures of keep those of the row before, if these are of the same commit.

    Args:
        path: the CSV file; the page has its name with ``.md``.
        row: a value for each of ``COLUMNS``, or for some.

    Returns:
        The cases whose figures of an earlier commit are gone.
    """
    rows, lost = read_kept(path), []
    text = {name: "" if row.get(name) is None else str(row[name]) for name in COLUMNS}
    place = next((i for i, old in enumerate(rows) if all(old[key] == text[key] for key in KEY)), len(rows))
    for case in CASES if place < len(rows) else ():
        names = [column.name for column in case.columns]
        old = {name: rows[place][name] for name in names}
        if any(old.values()) and not any(text[name] for name in names):
            if rows[place]["commit"] == text["commit"]:
                text |= old
            else:
                lost.append(case.name)
    rows[place : place + 1] = [text]
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    write_text(path.with_suffix(".md"), page(rows))
    return lost


def read_kept(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file, none if there is no file; columns that it lacks are empty."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [{name: row.get(name) or "" for name in COLUMNS} for row in csv.DictReader(file)]


def page(rows: Sequence[Mapping[str, str]]) -> str:
    """Return the page: a table for each case, and one of what the rows are."""
    parts = [
        "# Networks on rooms and real videos\n",
        "Written by [`real.py`](README.md#networks-on-real-videos) from the CSV file beside it.\n",
    ]
    for case in CASES:
        shown = [row for row in rows if any(row[column.name] for column in case.columns)]
        if shown:
            cells = [[_shown(row[column.name], column) for column in case.columns] for row in shown]
            titles = [column.title for column in case.columns]
            parts += [f"## {case.title}\n", _table(["network", *titles], shown, cells)]
    how = [[row[name] for name in HOW[1:]] for row in rows]
    parts += ["## What was measured\n", _table(["network", *HOW[1:]], rows, how)]
    return "\n".join(parts)


def _shown(value: str, column: Column) -> str:
    return "–" if value == "" else column.form.format(column.per * float(value))


def _table(titles: Sequence[str], rows: Sequence[Mapping[str, str]], cells: Sequence[Sequence[str]]) -> str:
    lines = [titles, ["---"] * len(titles)]
    lines += [[row["name"], *line] for row, line in zip(rows, cells, strict=True)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
