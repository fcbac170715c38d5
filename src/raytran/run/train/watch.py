# SPDX-License-Identifier: Apache-2.0
"""The callbacks that watch a run and change nothing in it, but for steps they skip."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from omegaconf import DictConfig

from raytran.errors import ConfigError
from raytran.run.train.settings import RunConfig
from raytran.training.callbacks.health import Health
from raytran.training.callbacks.scene_pictures import ScenePictures
from raytran.training.callbacks.telemetry import Telemetry

PICTURES = "pictures"


def watching_callbacks(cfg: DictConfig, run: RunConfig, card: dict[str, Any]) -> list[pl.Callback]:
    """Return the callbacks that ``cfg.watch`` describes.

    Args:
        cfg: the root config.
        run: the same config's switches.
        card: what each checkpoint carries.

    Raises:
        ConfigError: a number of steps or scenes is out of range.
    """
    folder = Path(run.output_dir)
    max_skipped, pictures = cfg.watch.max_skipped, cfg.watch.pictures
    if not isinstance(max_skipped, int) or max_skipped < 1:
        raise ConfigError(f"watch.max_skipped must be a number of steps, at least 1, got {max_skipped}")
    if not isinstance(pictures, int) or pictures < 0:
        raise ConfigError(f"watch.pictures must be a number of scenes or 0 for none, got {pictures}")
    callbacks: list[pl.Callback] = [
        Health(max_skipped=max_skipped),
        Telemetry(card["config"]),
    ]
    if pictures:
        callbacks.append(ScenePictures(folder / PICTURES, scenes=pictures))
    return callbacks
