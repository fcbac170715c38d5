# SPDX-License-Identifier: Apache-2.0
"""What a run costs: seconds of a step, scenes per second, memory; its settings and its final score."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import MLFlowLogger, TensorBoardLogger, WandbLogger

from raytran.training.loggers import was_logged_step

_GB = 1e9
_MAXRSS_UNIT = 1 if sys.platform == "darwin" else 1024

HP_METRIC = "hp_metric"
"""Name under which TensorBoard's table of settings expects the score of a run."""


class Telemetry(pl.Callback):
    """Logs time and memory at the steps at which the losses are logged.

    ``time/compute`` seconds of a step from the batch's arrival to the weights' change, mean over the steps
    since the last logging; ``time/data`` the time between two steps, mostly waiting for data (logging and
    the writing of checkpoints are in it too, validations are not); ``time/scenes_per_second`` of all ranks;
    ``memory/process`` and ``memory/gpu``, the highest use so far of the first rank, GB. Lightning's
    ``ThroughputMonitor`` would make the host wait for the device once more in every step, and its
    ``DeviceStatsMonitor`` logs some 150 columns.
    """

    def __init__(self) -> None:
        self._ended: float | None = None
        self._began = 0.0
        self._restart()

    def _restart(self) -> None:
        """Begin new means."""
        self._data = self._compute = 0.0
        self._scenes = self._batches = 0

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Take the time at which the batch is there."""
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
        if ends_step and was_logged_step(trainer):
            pl_module.log_dict(self._values(pl_module.device, trainer.accumulate_grad_batches))
            self._restart()

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave the validation, and all that other callbacks do after it, out of the next step's time."""
        self._ended = None

    def _values(self, device: torch.device, batches_per_step: int) -> dict[str, float]:
        values = {"memory/process": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _MAXRSS_UNIT / _GB}
        if device.type == "cuda":
            values["memory/gpu"] = torch.cuda.max_memory_allocated(device) / _GB
        if self._batches:
            steps = self._batches / batches_per_step
            values["time/data"] = self._data / steps
            values["time/compute"] = self._compute / steps
            values["time/scenes_per_second"] = self._scenes / (self._data + self._compute)
        return values


class RunSettings(pl.Callback):
    """Hands a run's settings to its loggers, and at the end the score that runs are compared by.

    TensorBoard's table of settings (HPARAMS) needs both at once, so it gets the settings with the score. Its
    columns come in the order of the settings: those first in which runs differ.

    Args:
        settings: of the run, plain Python.
        metric: name of a logged value, e.g. ``val/objects/accuracy_class``, whose last one is the
            score; None for no score.
        first: names of settings whose columns come first, e.g. ``optimizer.learning_rate``.
    """

    def __init__(self, settings: Mapping[str, Any], *, metric: str | None, first: Sequence[str] = ()) -> None:
        self._settings = dict(settings)
        self._metric = metric
        self._first = [name.replace("/", ".") for name in first]

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log the settings."""
        for logger in trainer.loggers:
            if not isinstance(logger, TensorBoardLogger):
                logger.log_hyperparams(self._settings)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log the score as ``hp_metric``, if the metric was ever logged."""
        score = None if self._metric is None else trainer.callback_metrics.get(self._metric)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                scores = {} if score is None else {HP_METRIC: float(score)}
                logger.log_hyperparams(self._columns(), scores, step=trainer.global_step)
            elif isinstance(logger, WandbLogger) and score is not None:
                logger.experiment.summary[HP_METRIC] = float(score)
            elif isinstance(logger, MLFlowLogger) and score is not None:
                logger.log_metrics({HP_METRIC: float(score)}, trainer.global_step)

    def _columns(self) -> dict[str, Any]:
        """Return the settings by dotted name, without those that say which class is built."""
        leaves = dict(_leaves(self._settings))
        ordered = [name for first in self._first for name in leaves if f"{name}.".startswith(f"{first}.")]
        return {name: leaves[name] for name in [*ordered, *leaves]}


def _leaves(node: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in node.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{path}{name}.")
        elif name != "_target_":
            yield f"{path}{name}", value
