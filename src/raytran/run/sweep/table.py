# SPDX-License-Identifier: Apache-2.0
"""What came out of a sweep: a table in the terminal, ``results.csv`` for everything else."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from raytran.data.files import write_text

RESULTS = "results.csv"
FINISHED, FINISHED_BEFORE, FAILED = "finished", "finished before", "failed"
STOPPED, NOT_STARTED = "stopped", "not started"
_OF_EVERY_JOB = ("job", "status", "exit_code", "metric", "value", "steps", "seconds", "folder")


@dataclass(frozen=True, kw_only=True)
class JobResult:
    """How a job of a sweep ended.

    Attributes:
        number: of the job.
        overrides: its settings.
        folder: of its run.
        status: one of the five above; a job is stopped by a signal to the sweep.
        exit_code: of its command, None if that was not run.
        metric: name of the number that the sweep is about.
        value: its last value, None if there is none.
        steps: optimiser steps of the finished run.
        seconds: time of this call alone.
    """

    number: int
    overrides: tuple[str, ...]
    folder: Path
    status: str
    exit_code: int | None
    metric: str
    value: float | None
    steps: int | None
    seconds: float


def report(folder: Path, results: Sequence[JobResult]) -> None:
    """Add the results to ``results.csv`` of the sweep; if they are several, show the table of all jobs."""
    rows = merged_rows(folder, results)
    settings = sorted({name for row in rows for name in row if name not in _OF_EVERY_JOB})
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=[*_OF_EVERY_JOB, *settings], restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / RESULTS, text.getvalue())
    if len(results) > 1:  # a sampler that draws one job after another shows its own best
        Console(soft_wrap=True).print(results_table(rows, title=f"sweep {folder}"))


def merged_rows(folder: Path, results: Sequence[JobResult]) -> list[dict[str, str]]:
    """Return a row for every job of the sweep: of the new results, and of those in ``results.csv``."""
    path = folder / RESULTS
    rows: dict[int, dict[str, str]] = {}
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            rows = {int(row["job"]): row for row in csv.DictReader(file)}
    for result in results:
        earlier = rows.get(result.number, {})
        if result.status != FINISHED_BEFORE or earlier.get("status") != FINISHED:
            rows[result.number] = _row(result, folder)  # else what the call that ran it has written stays
    return [rows[number] for number in sorted(rows)]


def _row(result: JobResult, folder: Path) -> dict[str, str]:
    settings = dict(item.partition("=")[::2] for item in result.overrides)
    return settings | {
        "job": str(result.number),
        "status": result.status,
        "exit_code": "" if result.exit_code is None else str(result.exit_code),
        "metric": result.metric,
        "value": "" if result.value is None else repr(result.value),
        "steps": "" if result.steps is None else str(result.steps),
        "seconds": f"{result.seconds:.1f}",
        "folder": str(result.folder.relative_to(folder)),
    }


def results_table(rows: Sequence[Mapping[str, str]], *, title: str) -> Table:
    """Return the rows as a table for the terminal; settings that all jobs share are left out."""
    names = sorted({name for row in rows for name in row if name not in _OF_EVERY_JOB})
    varied = [name for name in names if len({row.get(name, "") for row in rows}) > 1]
    metrics = sorted({row["metric"] for row in rows})
    table = Table(title=title)
    for name in ("job", *varied, "status", *metrics, "steps", "seconds"):
        table.add_column(name, overflow="fold")
    for row in rows:
        values = [
            f"{float(row['value']):.4g}" if name == row["metric"] and row["value"] else "" for name in metrics
        ]
        table.add_row(
            row["job"],
            *(row.get(name, "") for name in varied),
            row["status"],
            *values,
            row["steps"],
            row["seconds"],
        )
    return table
