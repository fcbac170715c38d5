# SPDX-License-Identifier: Apache-2.0
"""How many scenes a step takes, and whether the schedule is made for as many."""

from __future__ import annotations

import logging

import lightning.pytorch as pl

_log = logging.getLogger(__name__)


class EffectiveBatch(pl.Callback):
    """Logs the scenes of a step at the start, and warns where the schedule's steps and rates are for others.

    Args:
        per_device: scenes of a device in one pass.
        expected: scenes of a step that steps and learning rate are chosen for.
    """

    def __init__(self, *, per_device: int, expected: int) -> None:
        self._per_device = per_device
        self._expected = expected

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Say it once, on the first rank."""
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
