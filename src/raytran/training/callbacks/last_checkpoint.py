# SPDX-License-Identifier: Apache-2.0
"""Keeps one resumable checkpoint: every N steps, at the end, and when the user interrupts."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.utilities.exceptions import SIGTERMException

_log = logging.getLogger(__name__)


class LastCheckpoint(pl.Callback):
    """Writes ``path`` and puts the run's card into it.

    The first Ctrl-C lets the step in hand finish, so that the weights on disk are those of a whole step; a
    second one stops at once and leaves the last periodic checkpoint. With several processes a rank cannot
    know at which step the others stop, so there only the periodic checkpoint remains.

    Args:
        path: the file to write.
        every_n_steps: optimiser steps between two writings.
        card: plain Python that every checkpoint carries: format, stage, preset, model config, versions, ….
    """

    def __init__(self, path: Path, *, every_n_steps: int, card: Mapping[str, Any]) -> None:
        self._path = path
        self._every_n_steps = every_n_steps
        self._card = dict(card)
        self._interrupted = False
        self._written_at = -1
        self._earlier_handler: Any = None

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the card."""
        checkpoint.update(self._card)

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Listen for Ctrl-C."""
        self._written_at = trainer.global_step
        if trainer.world_size == 1 and threading.current_thread() is threading.main_thread():
            self._earlier_handler = signal.signal(signal.SIGINT, self._on_interrupt)

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Write every N steps, and before stopping at the user's wish."""
        if self._interrupted or trainer.global_step - self._written_at >= self._every_n_steps:
            self._write(trainer)
        if self._interrupted:
            raise KeyboardInterrupt

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Write the final checkpoint."""
        if trainer.global_step != self._written_at or not self._path.is_file():
            self._write(trainer)

    def on_exception(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException
    ) -> None:
        """Write if the machine asked to stop (Lightning raises between two batches); say how to go on."""
        if isinstance(exception, SIGTERMException) and trainer.world_size == 1:
            self._write(trainer)
        if isinstance(exception, KeyboardInterrupt | SIGTERMException):
            _log.info("stopped; resume=auto continues from step %d", max(0, self._written_at))

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Stop listening."""
        if self._earlier_handler is not None:
            signal.signal(signal.SIGINT, self._earlier_handler)
            self._earlier_handler = None

    def _write(self, trainer: pl.Trainer) -> None:
        trainer.save_checkpoint(self._path)
        self._written_at = trainer.global_step

    def _on_interrupt(self, signum: int, frame: FrameType | None) -> None:
        if self._interrupted:
            raise KeyboardInterrupt
        self._interrupted = True
        _log.info("stopping after this step; press Ctrl-C again to stop at once")
