# SPDX-License-Identifier: Apache-2.0
"""Training runs side by side, from what they left in their folders."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import yaml
from omegaconf import DictConfig

from raytran.checkpoints.runs import read_finished
from raytran.errors import CheckpointError, ConfigError, DataError
from raytran.pictures.curves import History
from raytran.pictures.run_comparison import RunRecord, final, write_run_comparison
from raytran.run.train.loggers import METRICS, read_history

_log = logging.getLogger(__name__)

_OF_THE_RUN = ("output_dir", "outputs", "resume", "init_from", "progress_bar")
"""Settings that say where a run lives, not what it does."""


def report(cfg: DictConfig) -> Path:
    """Run ``python -m raytran.report``: write the page and say where it is.

    Raises:
        DataError: a folder is missing or holds no run that can be read.
        ConfigError: the page cannot be written where it is wanted.
    """
    given = [cfg.runs] if isinstance(cfg.runs, str) else list(cfg.runs)
    folders = find_runs([Path(name) for name in given])
    records, notes = read_runs(folders)
    output = Path(cfg.output)
    if output.is_dir():
        output = output / "report.html"
    try:
        write_run_comparison(output, records, notes=notes)
    except OSError as error:
        raise ConfigError(f"cannot write {output} ({error.strerror}): choose another output=") from error
    for note in notes:
        _log.warning("%s", note)
    _log.info("%d run%s compared in %s", len(records), "" if len(records) == 1 else "s", output)
    return output


def find_runs(given: Sequence[Path]) -> list[Path]:
    """Return the folders of runs, those below a given one by name.

    Raises:
        DataError: a folder is missing or has no run in it.
    """
    found: dict[Path, None] = {}
    for folder in given:
        if not folder.is_dir():
            raise DataError(f"no folder {folder}: give the folder of a run, which holds {METRICS}")
        below = [path.parent for path in sorted(folder.rglob(METRICS))]
        if not below:
            raise DataError(
                f"{folder} holds no {METRICS}: give the folder of a run that has logged something, "
                "or one with runs below it"
            )
        found.update(dict.fromkeys(path.resolve() for path in below))
    return list(found)


def read_runs(folders: Sequence[Path]) -> tuple[list[RunRecord], list[str]]:
    """Return the runs that can be read, and a sentence for each that cannot.

    Raises:
        DataError: none can be read.
    """
    records, notes = [], []
    for folder, name in zip(folders, _names(folders), strict=True):
        try:
            history = read_history(folder)
            if not history:
                raise DataError(f"{folder / METRICS} has no rows yet")
            settings = _yaml(folder / "config.yaml")
            records.append(
                RunRecord(name, history, _flat(settings), _facts(folder, history, settings, _origin(folder)))
            )
        except (DataError, CheckpointError) as error:
            notes.append(f"{name} is left out: {error}")
        except (ValueError, TypeError, KeyError, OSError, yaml.YAMLError) as error:
            reason = str(error).splitlines()[0]
            notes.append(f"{name} is left out: its files cannot be read ({reason})")
    if not records:
        raise DataError(f"none of the runs can be read: {notes[0]}")
    return records, notes


def _names(folders: Sequence[Path]) -> list[str]:
    """Return what tells the folders apart: their paths below the folder they share."""
    if len(folders) == 1:
        return ["/".join(folders[0].parts[-2:])]
    shared = Path(os.path.commonpath(folders))
    return [folder.relative_to(shared).as_posix() if folder != shared else folder.name for folder in folders]


def _facts(
    folder: Path, history: History, settings: Mapping[str, Any], origin: Mapping[str, Any]
) -> dict[str, str]:
    last = max(pairs[-1][0] for pairs in history.values()) + 1
    mark, versions = read_finished(folder), origin.get("versions", {})
    planned = settings.get("trainer", {}).get("max_steps")
    seconds = training_seconds(history)
    rate = [value for _, value in history.get("time/scenes_per_second", ())]
    return {
        "stage": str(settings.get("stage", {}).get("name", "–")),
        "preset": str(settings.get("preset", "–")),
        "steps": f"{last:,}" if mark or not planned else f"{last:,} of {planned:,}",
        "state": f"finished {mark.time[:16].replace('T', ' ')} UTC" if mark else "not finished",
        "time in steps": "–" if seconds is None else _duration(seconds),
        "scenes/s": f"{median(rate):.2f}" if rate else "–",
        "memory": _memory(history),
        "machine": str(origin.get("machine") or origin.get("platform", "–")),
        "torch": str(versions.get("torch", "–")),
        "commit": str(origin.get("git_commit") or "–")[:7],
    }


def _memory(history: History) -> str:
    """Return the most that the first rank has used, on the GPU if it has one."""
    for name, place in (("memory/gpu", " on the GPU"), ("memory/process", "")):
        value = final(history, name)
        if value is not None:
            return f"{value:.1f} GB{place}"
    return "–"


def training_seconds(history: History) -> float | None:
    """Return the time that the steps took, from the means logged between them; None if none were logged."""
    parts = [dict(history.get(f"time/{name}", ())) for name in ("data", "compute")]
    total, before = 0.0, -1
    for step in sorted(parts[1]):
        total += (parts[0].get(step, 0.0) + parts[1][step]) * (step - before)
        before = step
    return total if parts[1] else None


def _origin(folder: Path) -> dict[str, Any]:
    path = folder / "provenance.json"
    content = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return content if isinstance(content, dict) else {}


def _yaml(path: Path) -> dict[str, Any]:
    content = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return content if isinstance(content, dict) else {}


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, object]:
    """Return settings by their dotted names, but for those that say where a run lives."""
    flat: dict[str, object] = {}
    for key, value in settings.items():
        name = f"{prefix}{key}"
        if name in _OF_THE_RUN:
            continue
        if isinstance(value, Mapping) and value:
            flat |= _flat(value, f"{name}.")
        else:
            flat[name] = value
    return flat


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"
