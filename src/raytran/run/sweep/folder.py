# SPDX-License-Identifier: Apache-2.0
"""The folder of a sweep, found again by the same command, and the results that its jobs left there.

A sweep lives in ``<outputs>/sweeps/<time>``, apart from single runs, so that ``init_from=auto`` never takes
one of its jobs.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from raytran.checkpoints.runs import read_finished
from raytran.checkpoints.sweeps import RECORD, read_record
from raytran.data.files import write_json
from raytran.errors import ConfigError
from raytran.training.history import read_history

THIS_SWEEP = "RAYTRAN_SWEEP_DIR"
"""Environment variable that hands a sweep's folder on to its jobs."""

_NOT_OF_A_JOB = ("launcher.", "sweep=", "output_dir=")


def own_settings(overrides: Sequence[str]) -> list[str]:
    """Return the settings that a job itself understands: all but those that say how to sweep."""
    return [item for item in overrides if not item.lstrip("+~").startswith(_NOT_OF_A_JOB)]


def sweep_folder(outputs: str, resume: str, program: str, overrides: Sequence[str]) -> str:
    """Return the folder for a sweep: the newest with the same command, or a new one named by the time.

    Args:
        outputs: top folder of all runs.
        resume: ``auto``, or ``none`` for a new folder in any case.
        program: name of the command's config, e.g. ``train``.
        overrides: what was typed after it.

    Raises:
        ConfigError: another ``resume``, or the record of an earlier sweep is damaged.
    """
    if resume not in ("auto", "none"):
        raise ConfigError(f"unknown launcher.resume={resume}: choose auto or none")
    parent = Path(outputs) / "sweeps"
    if resume == "auto":
        for path in sorted(parent.glob(f"*/{RECORD}"), reverse=True):
            if _command(program, overrides) == read_record(path.parent)["command"]:
                return str(path.parent)
    return str(parent / datetime.now().strftime("%Y-%m-%d_%H-%M-%S"))


def write_record(
    folder: Path, program: str, overrides: Sequence[str], jobs: Sequence[Mapping[str, Any]]
) -> None:
    """Write ``sweep.json``."""
    write_json(folder / RECORD, {"command": _command(program, overrides), "jobs": list(jobs)})


def _command(program: str, overrides: Sequence[str]) -> list[str]:
    """Return what two commands must share to be one sweep: everything but how many jobs run at a time."""
    return [program, *sorted(item for item in overrides if not item.lstrip("+").startswith("launcher."))]


def last_value(folder: Path, metric: str) -> tuple[float | None, list[str]]:
    """Return the last value of a metric that a job logged, None if it logged none, and all names it did log.

    Args:
        folder: of the job: a run, or a curriculum, of which the latest stage that has the metric counts.
        metric: its name, e.g. ``val/occupancy/iou``.
    """
    names: set[str] = set()
    for run in [folder, *_stages(folder)]:
        history = read_history(run)
        if history.get(metric):
            return history[metric][-1][1], sorted(history)
        names |= set(history)
    return None, sorted(names)


def _stages(folder: Path) -> list[Path]:
    """Return the finished runs inside a curriculum, the latest first."""
    marks = {path: read_finished(path) for path in folder.iterdir() if path.is_dir()}
    found = [(mark.time, path) for path, mark in marks.items() if mark is not None]
    return [path for _, path in sorted(found, reverse=True)]


def register_sweep_resolver() -> None:
    """Make ``${sweep_folder:…}`` known to the configs."""
    OmegaConf.register_new_resolver("sweep_folder", _folder_of_this_sweep, replace=True)


def _folder_of_this_sweep(outputs: str, resume: str, program: str, overrides: Sequence[str]) -> str:
    """Return one folder for all processes of a sweep: a queue may start a job hours later elsewhere."""
    if THIS_SWEEP not in os.environ:
        os.environ[THIS_SWEEP] = str(Path(sweep_folder(outputs, resume, program, overrides)).absolute())
    return os.environ[THIS_SWEEP]
