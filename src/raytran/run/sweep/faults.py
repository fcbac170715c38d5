# SPDX-License-Identifier: Apache-2.0
"""Faults that all jobs of a sweep share: they are told once, and not by each job after half a minute."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any

from omegaconf import OmegaConf

from raytran.checkpoints.runs import LAST, PREVIOUS, read_finished
from raytran.errors import RaytranError
from raytran.run.sweep.job import FAILED, FINISHED, Job
from raytran.run.train.memory import TOO_SMALL

_SAYS = "raytran: "
"""How a command begins to say what is wrong; a defect of ours ends in another line."""


def no_parent(jobs: Iterable[Job]) -> RaytranError | None:
    """Return why none of the jobs can start, if what they start from is missing for all of them.

    Args:
        jobs: what is to run. Those that have finished do not count, and one that goes on needs no parent.
    """
    first: RaytranError | None = None
    known: dict[str, RaytranError | None] = {}
    for job in jobs:
        if read_finished(job.folder) is not None:
            continue
        refusal = None if _needs_none(job) else _refusal(job, known)
        if refusal is None:
            return None
        first = first or refusal
    return first


def _needs_none(job: Job) -> bool:
    """Return whether a job starts at random, goes on, or is a curriculum, whose stages follow each other."""
    cfg = job.config
    starts_at_random = cfg.init_from == "none" or (cfg.init_from == "auto" and cfg.stage.parent is None)
    goes_on = any((job.folder / name).is_file() for name in (LAST, PREVIOUS))
    return starts_at_random or goes_on or cfg.get("stages") is not None


def _refusal(job: Job, known: dict[str, RaytranError | None]) -> RaytranError | None:
    """Return why a job finds no parent, None if it does; ``known`` are those asked for before."""
    # Imported here: it takes seconds, and most sweeps need it not.
    from raytran.checkpoints.metadata import DataIdentity
    from raytran.run.train.parent import find_parent, stage_of
    from raytran.run.train.settings import RunConfig

    cfg = OmegaConf.masked_copy(job.config, [str(key) for key in job.config if key != "hydra"])
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    try:
        data = DataIdentity.of_config(config)
    except RaytranError as error:
        return error
    wanted = [config[name] for name in ("preset", "outputs", "init_from", "stage")]
    key = json.dumps([*wanted, data.as_plain()], default=str)
    if key not in known:
        known[key] = None
        try:
            find_parent(RunConfig.read(cfg), stage_of(cfg), data)
        except RaytranError as error:
            known[key] = error
    return known[key]


def said_by_all(jobs: Sequence[Job]) -> str | None:
    """Return the sentence with which jobs fail before their first step, if two have said it and none got on.

    One job alone may fail of what is its own. That memory does not suffice is no such sentence: the next job
    may need less.

    Args:
        jobs: all jobs of a call.
    """
    failed = [job for job in jobs if job.status == FAILED]
    said = [job.said_last() for job in failed]
    if len(said) < 2 or len(set(said)) > 1 or not said[0].startswith(_SAYS) or TOO_SMALL in said[0]:
        return None
    if any(job.status == FINISHED or job.has_trained() for job in jobs):
        return None
    return said[0].removeprefix(_SAYS)
