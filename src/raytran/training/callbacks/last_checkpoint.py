# SPDX-License-Identifier: Apache-2.0
"""Keeps one resumable checkpoint: every N steps, at the end, and when the run is asked to stop."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import lightning.pytorch as pl
from lightning.pytorch.callbacks import ModelCheckpoint

from raytran.data.scan2cad import annotation_digest
from raytran.errors import CheckpointError
from raytran.training.callbacks.stop_signals import StopRequestedError, StopSignals
from raytran.training.checkpoint_io import AtomicCheckpointIO
from raytran.training.checkpoint_resume import loop_state, random_states, set_random_states
from raytran.training.ranks import average_statistics

_log = logging.getLogger(__name__)

_OF_LIGHTNING = {"optimizer_states", "lr_schedulers", "loops"}


@runtime_checkable
class ContinuedLogger(Protocol):
    """A logger whose record can be taken back to a step."""

    def continue_from(self, step: int) -> None:
        """Forget what was logged at ``step`` and later: the run does these steps again."""


class LastCheckpoint(pl.Callback):
    """Writes ``path``, puts the run's metadata into it, and continues a run from it exactly.

    A checkpoint is the state between two steps: after the validation that may follow the first, before the
    second. A run asked to stop during a long validation does not wait for its end; the validation is then
    done anew when the run is resumed.

    Args:
        path: the file to write.
        every_n_steps: optimiser steps between two writings.
        metadata: plain Python that every checkpoint carries: format, stage, preset, network, versions, ….
    """

    def __init__(self, path: Path, *, every_n_steps: int, metadata: Mapping[str, Any]) -> None:
        self._path = path
        self._every_n_steps = every_n_steps
        self._metadata = dict(metadata)
        self._signals = StopSignals()
        self._written_at = -1
        self._tried_at = -1
        self._scores: dict[str, float] = {}
        self._random: dict[str, Any] | None = None  # as it was before the validation that goes on
        self._resumed: dict[str, Any] | None = None

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the metadata, the scores of the last validation and what an exact resume needs."""
        states = self._random or random_states(pl_module.device)
        checkpoint.update(self._metadata)
        data = checkpoint.get("data")
        if isinstance(data, dict) and data.get("root") is not None:
            # Data that are made on first use were not there yet when the metadata was.
            checkpoint["data"] = {**data, "annotation": annotation_digest(Path(data["root"]))}
        checkpoint["scores"] = dict(self._scores)
        checkpoint["resume"] = {
            "validation_due": self._random is not None,
            "random": self._signals.gather(states),
        }

    def on_load_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Set Lightning's counters to what the checkpoint means; remember the rest for the first step."""
        resumed, step = checkpoint.get("resume"), checkpoint.get("global_step")
        if not (isinstance(resumed, dict) and isinstance(step, int) and checkpoint.keys() >= _OF_LIGHTNING):
            raise CheckpointError(
                f"{self._path} holds weights but no state of training: start a new run with init_from="
            )
        self._resumed = resumed
        self._scores = dict(checkpoint.get("scores", {}))
        del checkpoint["loops"]
        if step > 0:
            checkpoint["loops"] = loop_state(
                step,
                accumulate=trainer.accumulate_grad_batches,
                validation_due=bool(resumed["validation_due"]),
            )

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Listen for signals; if resumed, continue the random numbers and the logs."""
        self._signals.listen(trainer.world_size)
        self._written_at = self._tried_at = trainer.global_step
        for logger in trainer.loggers:
            if isinstance(logger, ContinuedLogger):
                logger.continue_from(trainer.global_step)
        if self._resumed is None:
            return
        steps = self._signals.gather(trainer.global_step)
        if len(set(map(str, steps))) > 1:
            raise CheckpointError(
                f"the ranks found checkpoints of different steps ({steps}) in {self._path.parent}: "
                "wait until all nodes see the same files, then try again"
            )
        states = self._resumed["random"]
        if len(states) == trainer.world_size:
            set_random_states(states[trainer.global_rank], pl_module.device)
        else:
            _log.warning(
                "the run had %d ranks and has %d now: it continues, but not with the same random numbers",
                len(states),
                trainer.world_size,
            )

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Between two steps: write every N steps, and before stopping where that is asked for."""
        if batch_idx % trainer.accumulate_grad_batches:
            return
        signum = self._signals.agreed()
        if signum or trainer.global_step - self._tried_at >= self._every_n_steps:
            self._write(trainer)
        if signum:
            self._stop(signum)

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Remember where the random numbers were, should the validation be cut short."""
        self._random = random_states(pl_module.device)

    def on_validation_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Stop in a long validation too, unless it is the last: a run that has all its steps just ends."""
        if trainer.global_step != trainer.max_steps and (signum := self._signals.agreed()):
            self._write(trainer)
            self._stop(signum)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Take down the scores, which later stages ask for."""
        self._random = None
        scores = {name: float(value) for name, value in trainer.callback_metrics.items()}
        self._scores = {name: value for name, value in scores.items() if name.startswith("val/")}
        self._scores["step"] = trainer.global_step

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Write the final checkpoint."""
        if trainer.global_step != self._written_at:
            self._write(trainer)

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let no run count as finished whose final checkpoint is missing; the ranks need no more each other.

        Raises:
            CheckpointError: it could not be written.
        """
        error = self._write_error(trainer)
        if error is not None:
            raise error

    def _write(self, trainer: pl.Trainer) -> None:
        average_statistics(trainer.lightning_module)
        trainer.save_checkpoint(self._path)
        self._tried_at = trainer.global_step
        error = self._write_error(trainer)
        if error is None:
            self._written_at = trainer.global_step
        else:
            _log.warning("%s; training goes on", error)

    def _write_error(self, trainer: pl.Trainer) -> CheckpointError | None:
        plugin = trainer.strategy.checkpoint_io
        return plugin.error if isinstance(plugin, AtomicCheckpointIO) else None

    def _stop(self, signum: int) -> None:
        _log.info("stopped; resume=auto continues from step %d", max(0, self._written_at))
        raise StopRequestedError(signum)


class BestCheckpoint(ModelCheckpoint):
    """Lightning's callback, but a validation without the monitored score ends no run: it is said once.

    A score may be missing because no validation scene has an object, or because its name is mistyped.
    """

    _is_missing_told = False

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Keep the weights if their score is the best so far."""
        if self.monitor in trainer.callback_metrics:
            super().on_validation_end(trainer, pl_module)
        elif trainer.is_global_zero and not self._is_missing_told:
            self._is_missing_told = True
            _log.warning("validation has no %s (optimized_metric): no best.ckpt is kept", self.monitor)
