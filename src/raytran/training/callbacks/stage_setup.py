# SPDX-License-Identifier: Apache-2.0
"""Applies the stage to the model, once, before DistributedDataParallel wraps it."""

from __future__ import annotations

import lightning.pytorch as pl

from raytran.training.reconstruction import Reconstruction


class StageSetup(pl.Callback):
    """Freezes what the stage does not train.

    A pure function of the config: nothing is remembered, nothing changes during the fit, so a resumed run is
    frozen like a fresh one, and DDP sees from the start the parameters whose gradients it must reduce.
    (Unfreezing inside a DDP fit desynchronises the ranks silently; ``BaseFinetuning`` re-freezes on resume.)
    """

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Freeze parameters; ``Reconstruction.train`` keeps the frozen parts in evaluation mode."""
        if isinstance(pl_module, Reconstruction):
            pl_module.stage.freeze(pl_module.model)
            pl_module.stage.set_mode(pl_module.model)
