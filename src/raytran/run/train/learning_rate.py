# SPDX-License-Identifier: Apache-2.0
"""A learning rate to begin with, found by Lightning's range test (Smith, 2017) before a run starts."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from hydra.utils import instantiate
from lightning.pytorch.tuner import Tuner
from matplotlib.figure import Figure
from omegaconf import DictConfig

from raytran.errors import ConfigError
from raytran.run.train.build import build_data, choose_precision, plain
from raytran.training.callbacks.stage import StageCallback
from raytran.training.lightning_module import Reconstruction

_log = logging.getLogger(__name__)

FIGURE = "learning_rate.png"
"""Loss against learning rate, in the folder of the run."""

_LOWEST, _HIGHEST, _STEPS = 1e-6, 1e-1, 100
_NEVER = 10**9

_OWN = {
    "max_steps": _STEPS,
    "val_check_interval": _NEVER,
    "fast_dev_run": False,
    "logger": False,
    "enable_checkpointing": False,
    "enable_progress_bar": False,
}
"""Settings of the Trainer that a search has of its own."""


class _Modes(pl.Callback):
    """Puts frozen parts into evaluation mode: during the search Lightning leaves out all other callbacks."""

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Set the modes of the stage before the search, which starts after it."""
        if isinstance(pl_module, Reconstruction):
            for module, training in pl_module.stage.training_modes(pl_module.model):
                module.training = training


def find_learning_rate(cfg: DictConfig, module: Reconstruction, stage: StageCallback) -> float:
    """Return the learning rate at which the loss falls most steeply, while it rises from step to step.

    All groups of parameters get the same rate, which takes the place of the schedule. The figure of the
    search is written into the folder of the run.

    Args:
        cfg: the root config.
        module: what would be trained; of no use afterwards.
        stage: what the stage is; it takes the parent's weights.

    Raises:
        ConfigError: the run has several devices, or the loss falls at no rate.
    """
    settings = plain(cfg.trainer)
    if settings["devices"] not in (1, "1") or settings["num_nodes"] != 1:
        raise ConfigError(
            "lr_find=true searches on one device: find the rate with trainer=cpu or trainer=gpu, then train "
            "with optimizer.learning_rate="
        )
    on_cpu = settings["accelerator"] == "cpu" or not torch.cuda.is_available()
    settings["precision"] = choose_precision(str(settings["precision"]), on_cpu=on_cpu)
    with tempfile.TemporaryDirectory() as folder:
        own: dict[str, Any] = {**_OWN, "default_root_dir": folder, "callbacks": [stage]}
        trainer = instantiate({**settings, **own}, _convert_="all")
        tuner = Tuner(trainer)
        trainer.callbacks.insert(0, _Modes())
        search = tuner.lr_find(
            module,
            datamodule=build_data(cfg),
            min_lr=_LOWEST,
            max_lr=_HIGHEST,
            num_training=_STEPS,
            update_attr=False,
        )
    found = None if search is None else search.suggestion()
    if search is None or found is None:
        raise ConfigError("lr_find=true found no learning rate at which the loss falls: choose one yourself")
    target = Path(cfg.output_dir) / FIGURE
    target.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure()
    search.plot(suggest=True, ax=figure.add_subplot())
    figure.savefig(target)
    _log.info("learning rate %.3g, found in %d steps: %s", found, len(search.results["lr"]), target)
    return float(found)
