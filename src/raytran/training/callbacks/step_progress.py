# SPDX-License-Identifier: Apache-2.0
"""Progress of a fit in steps: stages are counted in steps, and an epoch may be a handful of rooms."""

from __future__ import annotations

import logging
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import TQDMProgressBar
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from raytran.training.live_bar import LiveBar, is_terminal
from raytran.training.loggers import was_logged_step

_log = logging.getLogger(__name__)

_LINES = 10
"""Lines per fit where there is no terminal to draw a bar on."""


class LossBar(TQDMProgressBar):
    """Lightning's bar with the loss of the last step that was logged."""

    _shown = ""

    def on_train_batch_end(self, trainer: pl.Trainer, *rest: Any) -> None:
        """Take the loss."""
        if was_logged_step(trainer):
            self._shown = _loss(trainer)
        super().on_train_batch_end(trainer, *rest)

    def get_metrics(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> dict[str, Any]:
        """Return what the bar shows."""
        return super().get_metrics(trainer, pl_module) | {"loss": self._shown.removeprefix("loss ")}


class StepProgress(pl.Callback):
    """A rich bar on a terminal, ten lines in a log file.

    Args:
        title: text before the bar.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._bar: LiveBar | None = None
        self._task: Any = None
        self._shown_at = 0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Draw the bar."""
        self._shown_at = trainer.global_step
        if not trainer.is_global_zero or not is_terminal():
            return
        columns = (
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[loss]}"),
        )
        self._bar = LiveBar(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *columns)
        self._task = self._bar.add_task(
            self._title, total=_total(trainer), completed=trainer.global_step, loss=""
        )
        self._bar.start()

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Show the steps done and the loss."""
        if self._bar is not None:
            self._bar.update(self._task, completed=trainer.global_step)
            if was_logged_step(trainer):  # to ask for the loss of every step would wait for the device
                self._bar.update(self._task, loss=_loss(trainer))
        elif trainer.is_global_zero and trainer.global_step - self._shown_at >= max(
            1, trainer.max_steps // _LINES
        ):
            self._shown_at = trainer.global_step
            _log.info(
                "%s: step %d of %s, %s", self._title, trainer.global_step, _total(trainer), _loss(trainer)
            )

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Leave the finished bar on the screen."""
        self._stop()

    def on_exception(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException
    ) -> None:
        """Leave the bar as it is: Lightning then tears no callback down, and the cursor would stay hidden."""
        self._stop()

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def _total(trainer: pl.Trainer) -> int | None:
    return trainer.max_steps if trainer.max_steps > 0 else None


def _loss(trainer: pl.Trainer) -> str:
    loss = trainer.callback_metrics.get("train/total")
    return "" if loss is None else f"loss {float(loss):.4g}"
