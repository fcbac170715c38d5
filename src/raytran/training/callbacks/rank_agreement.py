# SPDX-License-Identifier: Apache-2.0
"""Proof, during a parallel run, that all ranks train one and the same network."""

from __future__ import annotations

from itertools import chain

import lightning.pytorch as pl

from raytran.errors import RaytranError
from raytran.training.ranks import agree


class RankAgreement(pl.Callback):
    """Compares the ranks' weights and statistics bit by bit, at the start, at validations and at the end.

    Ranks that have parted train on without a word otherwise, each its own network, of which one is saved.
    """

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Compare what the fit starts from."""
        self._check(trainer, pl_module)

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Compare what is about to be judged."""
        self._check(trainer, pl_module)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Compare what the next stage starts from."""
        self._check(trainer, pl_module)

    def _check(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.world_size == 1:
            return
        if not agree(chain(pl_module.parameters(), pl_module.buffers()), pl_module.device):
            raise RaytranError(
                f"the ranks' networks differ at step {trainer.global_step}: continue from an earlier "
                "checkpoint with resume=, and report this with config.yaml and provenance.json of the run"
            )
