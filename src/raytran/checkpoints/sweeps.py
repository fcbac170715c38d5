# SPDX-License-Identifier: Apache-2.0
"""The record of a sweep: which jobs it has, and what tells them apart.

``sweep.json`` in the folder of a sweep holds its command and, for each job, its settings and folder.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from raytran.data.text import read_json_object
from raytran.errors import ConfigError, DataError

RECORD = "sweep.json"


def read_record(folder: Path) -> dict[str, Any]:
    """Return what ``sweep.json`` says: ``command`` and ``jobs``, a list of ``overrides`` and ``folder``.

    Raises:
        ConfigError: the file is damaged.
    """
    path = folder / RECORD
    damaged = ConfigError(f"{path} is damaged: delete it, or start a new sweep with launcher.resume=none")
    try:
        record = read_json_object(path)
    except DataError as error:
        raise damaged from error
    command, jobs = record.get("command"), record.get("jobs")
    if not _are_texts(command) or not isinstance(jobs, list):
        raise damaged
    for job in jobs:
        is_job = isinstance(job, dict) and _is_below(job.get("folder")) and _are_texts(job.get("overrides"))
        if not is_job:
            raise damaged
    return {"command": command, "jobs": jobs}


def _is_below(folder: Any) -> bool:
    """Say whether it is the path of a folder in another, which does not lead out of that."""
    return (
        isinstance(folder, str)
        and folder.isprintable()
        and not Path(folder).is_absolute()
        and ".." not in Path(folder).parts
    )


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def differences(record: Mapping[str, Any]) -> list[list[str]]:
    """Return for each job those of its settings that tell it from the others, such as ``["seed=1"]``.

    They are neither in the command as they stand nor the same in all jobs; of a sampler's jobs there may be
    just one so far.

    Args:
        record: as ``read_record`` gives it.
    """
    typed = set(record["command"])
    jobs = [list(job["overrides"]) for job in record["jobs"]]
    shared = set.intersection(*map(set, jobs)) if len(jobs) > 1 else set()
    return [[item for item in job if item not in shared and item not in typed] for job in jobs]


def varied_settings(run: Path) -> list[str]:
    """Return the names of the settings in which the jobs of a sweep differ; none for a run without a sweep.

    Args:
        run: folder of a job, or of a stage of one.
    """
    for folder in run.absolute().parents:
        if (folder / RECORD).is_file():
            try:
                own = differences(read_record(folder))
            except ConfigError:
                return []
            return list(dict.fromkeys(item.lstrip("+~").partition("=")[0] for job in own for item in job))
    return []
