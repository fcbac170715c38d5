# SPDX-License-Identifier: Apache-2.0
"""What a run costs: time of a step, scenes a second, memory; and the learning rate it goes by."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Mapping
from typing import Any

import lightning.pytorch as pl
import torch

_GB = 1e9
_MAXRSS_UNIT = 1 if sys.platform == "darwin" else 1024


class Telemetry(pl.Callback):
    """Logs where the losses are logged; hands the run's settings to the loggers that keep such.

    ``time/compute`` seconds of a step from the batch's arrival to the weights' change, mean over the steps
    since the last logging; ``time/data`` what lies between, nearly all of it waiting for data (logging and
    the writing of checkpoints are in it too, validations are not); ``time/scenes_per_second`` of all ranks;
    ``memory/process`` and ``memory/gpu``, the highest use so far of the first rank, GB;
    ``schedule/learning_rate``.

    Args:
        settings: of the run, plain Python.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._settings = dict(settings)
        self._ended: float | None = None
        self._began = 0.0
        self._data = 0.0
        self._compute = 0.0
        self._scenes = 0
        self._batches = 0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Say what is being run."""
        for logger in trainer.loggers:
            logger.log_hyperparams(self._settings)

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Take the time at which data are there."""
        self._began = time.perf_counter()

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Take the time at which the step is done; log."""
        now = time.perf_counter()
        if self._ended is not None:  # the first batch also starts the loader's workers and compiles kernels
            self._data += self._began - self._ended
            self._compute += now - self._began
            self._scenes += len(batch.scene_id) * trainer.world_size
            self._batches += 1
        self._ended = now
        ends_step = (batch_idx + 1) % trainer.accumulate_grad_batches == 0
        if ends_step and trainer._logger_connector.should_update_logs:
            self._log(trainer, pl_module)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave the validation, and all that other callbacks do after it, out of the next step's time."""
        self._ended = None

    def _log(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        values = {
            "schedule/learning_rate": trainer.optimizers[0].param_groups[0]["lr"],
            "memory/process": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _MAXRSS_UNIT / _GB,
        }
        if module.device.type == "cuda":
            values["memory/gpu"] = torch.cuda.max_memory_allocated(module.device) / _GB
        if self._batches:
            steps = self._batches / trainer.accumulate_grad_batches
            values["time/data"] = self._data / steps
            values["time/compute"] = self._compute / steps
            values["time/scenes_per_second"] = self._scenes / (self._data + self._compute)
        self._data = self._compute = 0.0
        self._scenes = self._batches = 0
        module.log_dict(values)
