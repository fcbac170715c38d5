# SPDX-License-Identifier: Apache-2.0
"""What came of a sweep: a table of its jobs, and how much of a difference is chance."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev

from raytran.checkpoints.runs import read_finished
from raytran.checkpoints.sweeps import read_record
from raytran.data.files import write_text
from raytran.run.sweep.folder import last_value
from raytran.run.sweep.job import FINISHED, NOT_STARTED, Job

_log = logging.getLogger(__name__)

RESULTS = "results.csv"

_SEED = "seed"


def write_results(folder: Path, jobs: Sequence[Job]) -> dict[int, float | None]:
    """Write ``results.csv`` with a row for every job of the sweep, and log the rows.

    What has finished is read from the jobs' folders, whichever call has run it.

    Returns:
        The last value of its metric, or None, for each job by number.
    """
    status = {job.number: job.status for job in jobs}
    metric = str(jobs[0].config.optimized_metric) if jobs else ""
    rows: list[dict[str, object]] = []
    values: dict[int, float | None] = {}
    for number, recorded in enumerate(read_record(folder)["jobs"]):
        mark = read_finished(folder / recorded["folder"])
        values[number] = _value(number, folder / recorded["folder"], metric) if mark else None
        rows.append(
            dict(item.partition("=")[::2] for item in recorded["overrides"])
            | {
                "job": number,
                "status": FINISHED if mark else status.get(number, NOT_STARTED),
                "metric": metric,
                "value": values[number],
                "steps": mark.steps if mark else None,
                "folder": recorded["folder"],
            }
        )
    first = ("job", "status", "metric", "value", "steps", "folder")
    settings = sorted({name for row in rows for name in row} - set(first))
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=[*first, *settings], restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / RESULTS, text.getvalue())
    varied = [name for name in settings if len({row.get(name) for row in rows}) > 1]
    for row in rows:
        _log.info("job %s: %s", row["job"], _line(row, varied))
    for line in _over_seeds(rows, varied):
        _log.info("%s", line)
    return values


def _over_seeds(rows: Sequence[Mapping[str, object]], varied: Sequence[str]) -> list[str]:
    """Return mean and standard deviation of the metric over jobs that differ in nothing but the seed."""
    if _SEED not in varied:
        return []
    others = [name for name in varied if name != _SEED]
    metric = rows[0]["metric"]
    groups: dict[str, list[float]] = {}
    for row in rows:
        value = row["value"]
        if isinstance(value, float):
            alike = " ".join(f"{name}={row[name]}" for name in others if name in row)
            groups.setdefault(alike, []).append(value)
    return [
        f"{alike or 'all'}, {len(values)} seeds: {metric} = {mean(values):.4g} ± {stdev(values):.2g}"
        for alike, values in groups.items()
        if len(values) > 1
    ]


def _value(number: int, folder: Path, metric: str) -> float | None:
    """Return the last value of a metric, and say which ones there are where there is none."""
    value, logged = last_value(folder, metric)
    if logged and value is None:
        others = ", ".join(name for name in logged if name.startswith("val/")) or "none"
        _log.warning("job %d logged no %s: optimized_metric can be %s", number, metric, others)
    return value


def _line(row: Mapping[str, object], varied: Sequence[str]) -> str:
    """Return a row in one line: the settings that differ between the jobs, and what came of them."""
    settings = " ".join(f"{name}={row[name]}" for name in varied if name in row)
    value = row["value"]
    score = f", {row['metric']} = {value:.4g}" if isinstance(value, float) else ""
    return f"{settings} {row['status']}{score}".strip()
