# SPDX-License-Identifier: Apache-2.0
"""What to type after a run has ended."""

from __future__ import annotations

import logging
import shlex
from pathlib import Path

from omegaconf import DictConfig

from raytran.checkpoints.metadata import DataIdentity
from raytran.run.train.build import plain
from raytran.run.train.fit import FitResult

_log = logging.getLogger(__name__)

_AFTER = {"stage1": "stage2", "stage2": "stage3"}
"""Experiment of the curriculum → the one that goes on from it."""


def tell_after_stage(cfg: DictConfig, result: FitResult) -> None:
    """Log the command that goes on from a finished stage.

    Args:
        cfg: the settings of the run.
        result: what it came to.
    """
    following = _AFTER.get(str(cfg.experiment))
    if following is None:
        tell_use(result.checkpoint)
        return
    data = DataIdentity.of_config(plain(cfg)).typed()
    outputs = [] if cfg.outputs == "outputs" else [shlex.quote(f"outputs={cfg.outputs}")]
    words = [f"experiment={following}", f"preset={cfg.preset}", *([data] if data else []), *outputs]
    _log.info("next: raytran train %s", " ".join(words))


def tell_use(checkpoint: Path) -> None:
    """Log what a finished network is good for."""
    typed = shlex.quote(f"checkpoint={checkpoint}")
    _log.info("next: raytran evaluate %s, or raytran predict SCENE %s", typed, typed)
