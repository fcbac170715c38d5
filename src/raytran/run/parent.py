# SPDX-License-Identifier: Apache-2.0
"""The stage before: which checkpoint a new run starts from, and whether that has learned enough for it."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from raytran.errors import CheckpointError, ConfigError
from raytran.run.folders import newest_finished
from raytran.run.settings import RunConfig
from raytran.training.stage import Stage

_log = logging.getLogger(__name__)

_ANYWAY = "or give check_parent=false to start from it all the same"


@dataclass(frozen=True)
class Parent:
    """Where the first weights of a run come from.

    Attributes:
        path: of the checkpoint.
        stage: name of its stage.
        step: optimiser steps it had taken.
        scores: its last validation, by name.
    """

    path: str
    stage: str
    step: int
    scores: dict[str, float]

    @staticmethod
    def of(path: Path, checkpoint: Mapping[str, Any]) -> Parent:
        """Return what is to be remembered of a parent."""
        scores = checkpoint.get("scores")
        found = scores if isinstance(scores, dict) else {}
        step = checkpoint.get("global_step", 0)
        return Parent(str(path), checkpoint["stage"], int(step), {k: float(v) for k, v in found.items()})

    def as_plain(self) -> dict[str, Any]:
        """Return plain Python, to be written into a checkpoint."""
        return asdict(self)


def find_parent(run: RunConfig, stage: Stage) -> Path | None:
    """Return the checkpoint whose weights a new run starts from, None to start from scratch.

    Raises:
        ConfigError: ``init_from=auto`` finds no finished run of the parent stage.
    """
    if run.init_from not in ("auto", "none"):
        return Path(run.init_from)
    if run.init_from == "none" or stage.parent is None:
        return None
    found = newest_finished(Path(run.outputs), preset=run.preset, stage=stage.parent)
    if found is None:
        raise ConfigError(
            f"no finished run of stage {stage.parent} with preset {run.preset} under "
            f"{Path(run.outputs).resolve()}: run `python -m raytran.train "
            f"experiment={stage.parent_experiment} preset={run.preset}` first, "
            "or give init_from=CHECKPOINT, or init_from=none to start from scratch"
        )
    return found


def check_parent(parent: Parent, stage: Stage, *, refuse: bool) -> None:
    """Raise unless ``parent`` is of the stage that ``stage`` builds on, or of its own, and knows its task.

    Args:
        parent: the checkpoint to start from.
        stage: the stage to train.
        refuse: False only warns.

    Raises:
        CheckpointError: the parent is of another stage or its validation score is too low.
    """
    objection = _objection(parent, stage)
    if objection is None:
        return
    if refuse:
        raise CheckpointError(f"{parent.path} {objection}, {_ANYWAY}")
    _log.warning("%s %s; starting from it because of check_parent=false", parent.path, objection)


def _objection(parent: Parent, stage: Stage) -> str | None:
    if stage.parent is None or parent.stage == stage.name:
        return None
    again = f"train experiment={stage.parent_experiment}"
    if parent.stage != stage.parent:
        return f"is of stage {parent.stage}, but stage {stage.name} builds on {stage.parent}: {again} first"
    if stage.parent_score is None:
        return None
    score = parent.scores.get(f"val/{stage.parent_score}")
    task = stage.parent_score.partition("/")[0]
    if score is None:
        return (
            f"has never been validated, so that its {stage.parent_score} is unknown: {again} with validation"
        )
    if not score > stage.parent_minimum:
        return (
            f"has not learned {task}: its validation {stage.parent_score} is {score:.3g} and must exceed "
            f"{stage.parent_minimum:g} (stage.parent_minimum): {again} longer"
        )
    return None
