# SPDX-License-Identifier: Apache-2.0
"""Applies the stage to the model: what is frozen, and in which mode each part is while it trains."""

from __future__ import annotations

from typing import Any

import lightning.pytorch as pl
from torch import nn

from raytran.training.reconstruction import Reconstruction


class StageSetup(pl.Callback):
    """Freezes what the stage does not train, and keeps it in evaluation mode.

    A pure function of the config: nothing is remembered, nothing changes during the fit, so a resumed run is
    frozen like a fresh one, and DDP sees from the start the parameters whose gradients it must reduce.
    (Unfreezing inside a DDP fit desynchronises the ranks silently; ``BaseFinetuning`` re-freezes on resume.)
    """

    def __init__(self) -> None:
        self._modes: list[tuple[nn.Module, bool]] = []

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Freeze parameters, before DistributedDataParallel wraps the model."""
        if isinstance(pl_module, Reconstruction):
            pl_module.stage.freeze(pl_module.model)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Find the mode of each module; the ranks' batch norms have been exchanged by now."""
        if isinstance(pl_module, Reconstruction):
            self._modes = pl_module.stage.training_modes(pl_module.model)

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Set the modes before every step.

        Lightning never calls ``train()`` in a fit, and puts modes back one by one after a validation: neither
        an override of ``train`` nor modes that are set once can be relied upon.
        """
        for module, training in self._modes:
            if module.training != training:
                module.training = training
