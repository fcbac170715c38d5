# SPDX-License-Identifier: Apache-2.0
"""``report.md`` and ``report.json`` of ``gpu_day.py``."""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gpu_day.checks import Check
from raytran.data.files import write_json, write_text

_LINE = ("gpu", "driver", "torch", "triton", "cudnn", "nccl", "processor", "cores", "date", "commit")


@dataclass
class Part:
    """What is known of one part.

    Attributes:
        name: of the part.
        title: what it looks at.
        checks: what it found so far.
        seconds: that it took so far.
        state: ``to come``, ``running``, ``done`` or ``not run``.
    """

    name: str
    title: str
    checks: list[Check] = field(default_factory=list)
    seconds: float = 0.0
    state: str = "to come"


def write_report(folder: Path, machine: dict[str, Any], parts: Sequence[Part]) -> None:
    """Write both files anew."""
    write_json(
        folder / "report.json",
        {"machine": machine, "failed": len(failures(parts)), "parts": [asdict(part) for part in parts]},
    )
    write_text(folder / "report.md", "\n".join(_lines(machine, parts)) + "\n")


def failures(parts: Sequence[Part]) -> list[Check]:
    """Return the checks that failed."""
    return [check for part in parts for check in part.checks if check.verdict == "FAIL"]


def _lines(machine: dict[str, Any], parts: Sequence[Part]) -> list[str]:
    counts = Counter(check.verdict for part in parts for check in part.checks)
    waiting = [part.name for part in parts if part.state in ("running", "to come")]
    summary = ", ".join(f"{counts[verdict]} {word}" for verdict, word in _WORDS.items() if counts[verdict])
    lines = [
        "# raytran on this machine",
        "",
        ", ".join(f"{name} {machine[name]}" for name in _LINE if machine.get(name)) or "machine: unknown",
        "",
        f"{summary or 'nothing yet'}" + (f"; still to come: {', '.join(waiting)}" if waiting else ""),
    ]
    lines += ["", *(f"- **{check.name}**: {_result(check)}" for check in failures(parts))]
    for number, part in enumerate(parts, start=1):
        lines += ["", f"## {number}. {part.title}", ""]
        lines += [f"{part.state}, {datetime.timedelta(seconds=round(part.seconds))}", ""]
        if part.checks:
            lines += ["| check | bar | measured | |", "| --- | --- | --- | --- |"]
            lines += [_row(check) for check in part.checks]
        for check in part.checks:
            if check.notes:
                lines += ["", f"{check.name}:", "", "```", *check.notes, "```"]
    return lines


_WORDS = {"pass": "passed", "FAIL": "failed", "not measured": "not measured", "reported": "reported"}


def _row(check: Check) -> str:
    verdict = f"{check.verdict}: {check.why}" if check.why else check.verdict
    cells = (check.name, check.bar or "–", check.measured, verdict)
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def _result(check: Check) -> str:
    told = [
        check.measured if check.measured != "–" else "",
        f"bar {check.bar}" if check.bar else "",
        check.why,
    ]
    return "; ".join(part for part in told if part)
