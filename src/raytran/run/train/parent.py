# SPDX-License-Identifier: Apache-2.0
"""The stage before: which checkpoint a new run starts from, and whether that has learned enough for it."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from raytran.checkpoints.card import DataIdentity
from raytran.checkpoints.file import checkpoint_path, read_checkpoint
from raytran.checkpoints.runs import finished_runs
from raytran.errors import CheckpointError, ConfigError
from raytran.run.train.settings import RunConfig
from raytran.training.stage import Stage

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Parent:
    """Where the first weights of a run come from.

    Attributes:
        path: of the checkpoint.
        stage: name of its stage.
        step: optimiser steps it had taken.
        scores: its last validation, by name.
        data: what it was trained on, see ``DataIdentity.as_plain``; None if it does not say.
    """

    path: str
    stage: str
    step: int
    scores: dict[str, float]
    data: dict[str, Any] | None = None

    @staticmethod
    def of(path: Path, checkpoint: Mapping[str, Any]) -> Parent:
        """Return what is to be remembered of a parent.

        Raises:
            CheckpointError: the file says nothing sensible.
        """
        try:
            scores = {name: float(value) for name, value in checkpoint.get("scores", {}).items()}
            known = DataIdentity.of_checkpoint(checkpoint)
            step, data = int(checkpoint.get("global_step", 0)), None if known is None else known.as_plain()
            return Parent(str(path), checkpoint["stage"], step, scores, data)
        except (AttributeError, TypeError, ValueError) as error:
            raise CheckpointError(f"{path} says odd things of itself ({error}): it is damaged") from error

    def as_plain(self) -> dict[str, Any]:
        """Return plain Python, to be written into a checkpoint."""
        return asdict(self)


def find_parent(run: RunConfig, stage: Stage, data: DataIdentity) -> tuple[Path, dict[str, Any]] | None:
    """Return the checkpoint whose weights a new run starts from and its content, None to start from scratch.

    ``init_from=auto`` takes the newest finished run of the parent stage on the same data.

    Args:
        run: the switches.
        stage: the stage to train.
        data: what it is to be trained on.

    Raises:
        ConfigError: ``init_from=auto`` finds no finished run of the parent stage on these data.
        CheckpointError: the checkpoint is missing or damaged; or it is ``default``, and the package was built
            without weights.
    """
    if run.init_from not in ("auto", "none"):
        path = checkpoint_path(run.init_from)
        return path, read_checkpoint(path)
    if run.init_from == "none" or stage.parent is None:
        return None
    others: list[str] = []
    for path, mark in finished_runs(
        Path(run.outputs), preset=run.preset, stage=stage.parent, experiment=stage.parent_experiment
    ):
        content = None if mark.data else read_checkpoint(path)
        known = DataIdentity.of_checkpoint({"data": mark.data} if content is None else content)
        if known is None or known.is_same(data):
            return path, read_checkpoint(path) if content is None else content
        others.append(f"{path} on {known}")
    raise ConfigError(_no_parent(run, stage, data, others))


def _no_parent(run: RunConfig, stage: Stage, data: DataIdentity, others: list[str]) -> str:
    first = f"`python -m raytran.train experiment={stage.parent_experiment} preset={run.preset}"
    where = f"under {Path(run.outputs).resolve()}"
    if not others:
        return (
            f"no finished run of {stage.parent} with preset {run.preset} {where}: run {first}` first, "
            "or give init_from=CHECKPOINT, or init_from=none to start from scratch"
        )
    more = f" and {len(others) - 1} more" if len(others) > 1 else ""
    return (
        f"no finished run of {stage.parent} with preset {run.preset} {where} "
        f"was trained on {data}, only on other data ({others[0]}{more}): run {first} {data.typed()}` first, "
        "or give init_from=CHECKPOINT to start from other data all the same, or init_from=none to start "
        "from scratch"
    )


def check_parent(parent: Parent, stage: Stage, check: str) -> None:
    """Raise unless ``parent`` is of a stage that ``stage`` builds on, or of its own, and knows its task.

    Args:
        parent: the checkpoint to start from.
        stage: the stage to train.
        check: ``scores``, or ``stage`` to leave out its task, or ``none`` to warn only.

    Raises:
        CheckpointError: the parent is of another stage or its validation score is too low.
    """
    if stage.parent is None or parent.stage in (stage.name, *stage.other_parents):
        return
    again = f"train experiment={stage.parent_experiment}"
    if parent.stage != stage.parent:
        objection = f"{parent.path} is of {parent.stage}, but {stage.name} builds on {stage.parent}"
        if check == "none":
            _log.warning("%s", objection)
            return
        raise CheckpointError(f"{objection}: {again} first, or force it with check_parent=none")
    unlearned = _unlearned(parent, stage) if check == "scores" else None
    if unlearned is not None:
        raise CheckpointError(
            f"{parent.path} {unlearned}: {again} longer, or force it with check_parent=stage"
        )


def _unlearned(parent: Parent, stage: Stage) -> str | None:
    """Say why ``parent`` has not learned its task, None if it has."""
    if stage.parent_score is None:
        return None
    score = parent.scores.get(f"val/{stage.parent_score}")
    if score is None:
        return f"has never been validated, so that its {stage.parent_score} is unknown"
    if not score > stage.parent_minimum:
        return (
            f"has not learned {stage.parent_score.partition('/')[0]}: its validation {stage.parent_score} "
            f"is {score:.3g} and must exceed {stage.parent_minimum:g} (stage.parent_minimum)"
        )
    return None
