# SPDX-License-Identifier: Apache-2.0
"""What a run checks about itself: scenes per step, equal weights on all ranks, frames given twice."""

from __future__ import annotations

import logging
from itertools import chain
from typing import Any

import lightning.pytorch as pl

from raytran.data.views import RepeatedFrames
from raytran.errors import RaytranError
from raytran.training.ranks import agree, average_statistics

_log = logging.getLogger(__name__)


class EffectiveBatch(pl.Callback):
    """Logs the scenes per step at the start; warns if steps and learning rate are chosen for another number.

    Args:
        per_device: scenes per device in one forward pass.
        expected: scenes per step that the schedule's steps and learning rate are chosen for.
    """

    def __init__(self, *, per_device: int, expected: int) -> None:
        self._per_device = per_device
        self._expected = expected

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log once, on the first rank."""
        if not trainer.is_global_zero:
            return
        nodes, accumulated = trainer.num_nodes, trainer.accumulate_grad_batches
        devices = trainer.world_size // nodes
        batch = trainer.world_size * self._per_device * accumulated
        _log.info(
            "%d scenes a step: %d devices × %d nodes × views.batch_size=%d × "
            "trainer.accumulate_grad_batches=%d, precision %s",
            *(batch, devices, nodes, self._per_device, accumulated, trainer.precision),
        )
        if batch != self._expected:
            _log.warning("%s", self._advice(batch, trainer.world_size))

    def _advice(self, batch: int, ranks: int) -> str:
        scenes = ranks * self._per_device
        if self._expected % scenes == 0:
            change = f"trainer.accumulate_grad_batches={self._expected // scenes}"
        elif self._expected % ranks == 0:
            change = f"views.batch_size={self._expected // ranks} and trainer.accumulate_grad_batches=1"
        else:
            change = f"a number of devices that divides {self._expected}"
        return (
            f"steps and learning rate are chosen for {self._expected} scenes a step, not {batch}: "
            f"set {change}, or schedule.batch={batch} if it is meant so"
        )


class RankAgreement(pl.Callback):
    """Compares the ranks' weights and statistics bit by bit, at the start, at validations and at the end.

    Ranks whose weights differ would train on without an error, each its own network, of which one is saved.
    Batch norms that each rank computes alone are given the statistics of all ranks first.
    """

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Compare what the fit starts from."""
        self._check(trainer, pl_module)

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Compare what is about to be scored."""
        self._check(trainer, pl_module)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Compare what the next stage starts from."""
        self._check(trainer, pl_module)

    def _check(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.world_size == 1:
            return
        average_statistics(pl_module)
        if not agree(chain(pl_module.parameters(), pl_module.buffers()), pl_module.device):
            raise RaytranError(
                f"the ranks' networks differ at step {trainer.global_step}: continue from an earlier "
                "checkpoint with resume=, and report this with config.yaml and provenance.json of the run"
            )


class RepeatedFramesWarning(pl.Callback):
    """Warns once if validation repeats frames because scans have fewer than are asked for."""

    def __init__(self) -> None:
        self._repeated = RepeatedFrames()

    def on_validation_batch_start(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Look at one scene, on the first rank."""
        if trainer.is_global_zero:
            self._repeated.look(batch)
