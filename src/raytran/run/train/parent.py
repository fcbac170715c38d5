# SPDX-License-Identifier: Apache-2.0
"""What a stage starts from, and which stages start from it."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from raytran.checkpoints.file import checkpoint_path, read_checkpoint
from raytran.checkpoints.metadata import DataIdentity
from raytran.checkpoints.runs import finished_runs
from raytran.errors import ConfigError
from raytran.run.config_dir import config_dir
from raytran.run.train.settings import RunConfig
from raytran.training.stage import Stage

_log = logging.getLogger(__name__)

_MOST_NAMED = 5
"""Runs that are named of those that will not do."""


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
    for other in others[:_MOST_NAMED]:
        _log.warning("there is %s", other)
    raise ConfigError(_no_parent(run, stage, data, number_of_others=len(others)))


def _no_parent(run: RunConfig, stage: Stage, data: DataIdentity, *, number_of_others: int) -> str:
    runs = f"no finished run of {stage.parent} with preset {run.preset} in outputs={run.outputs}"
    first = f"`raytran train experiment={stage.parent_experiment} preset={run.preset}"
    otherwise = "or give init_from=CHECKPOINT, or init_from=none to start from scratch"
    if not number_of_others:
        return f"{runs}: run {first}` first, {otherwise}"
    others, first = f"{number_of_others} on others", f"{first} {data.typed()}"
    return f"{runs} is on these data, {others}: run {first}` first, {otherwise}"


def stage_of(cfg: DictConfig) -> Stage:
    """Return the stage that a config is of."""
    settings: Any = OmegaConf.to_container(cfg.stage, resolve=True)
    return Stage(**{name: value for name, value in settings.items() if name != "_target_"})


def stages_after(stage: Stage) -> list[Stage]:
    """Return the stages of ``conf/stage`` that build on ``stage``, as they are without any override."""
    after = []
    for path in sorted((config_dir() / "stage").glob("*.yaml")):
        content: Any = OmegaConf.to_container(OmegaConf.load(path))
        # A stage that brings a head of its own sets more than the stage.
        settings = content.get("stage", content)
        if settings.get("parent") == stage.name:
            after.append(Stage(**{name: settings[name] for name in settings if name != "_target_"}))
    return after
