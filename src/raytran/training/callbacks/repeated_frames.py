# SPDX-License-Identifier: Apache-2.0
"""Says once that validation repeats frames, because scans have fewer than are asked for."""

from __future__ import annotations

from typing import Any

import lightning.pytorch as pl

from raytran.data.views import RepeatedFrames


class RepeatedFramesWarning(pl.Callback):
    """Looks at the scenes of every validation that the first rank is given."""

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
        """Look at one scene."""
        if trainer.is_global_zero:
            self._repeated.look(batch)
