# SPDX-License-Identifier: Apache-2.0
"""An exponential moving average of the weights, which is what is scored, kept and handed on."""

from __future__ import annotations

from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch import distributed as dist
from torch.optim.swa_utils import get_ema_multi_avg_fn

from raytran.training.ranks import average_statistics

TRAINED = "trained_weights"
"""Where a checkpoint has the weights that the optimiser goes on from; its ``state_dict`` is their average."""


class AveragedWeights(pl.Callback):
    """Averages the weights and the running statistics of a run over its steps.

    After step n the average moves to the weights by ``1 - min(decay, (1 + n) / (10 + n))``, so that the
    random weights of the start are soon forgotten in short runs too. Validations, their pictures,
    ``state_dict`` of every checkpoint, and the network when the fit has ended have the average; a resumed run
    goes on from the weights as they were trained, which stand beside it. A step that was skipped moves the
    average towards weights that have not changed.

    Lightning's ``WeightAveraging`` keeps its average on the CPU unless told, lets the host wait for a counter
    in every step, takes the two for each other in a checkpoint that is written during a validation, and
    leaves nothing to go on from in one that is written at the end.

    It must stand behind the callbacks that write the last checkpoint and draw pictures: at the end of a
    validation and of the fit they come first.

    Args:
        decay: share of the average that stays at each step, once it is warm; above 0 and below 1.
    """

    def __init__(self, *, decay: float) -> None:
        self._decay = decay
        self._average: dict[str, Tensor] = {}
        self._is_in_place = False  # the network has the average, and ``_average`` holds what was trained
        self._resumed: dict[str, Tensor] = {}
        self._updated_at = 0

    def on_load_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Remember the weights to go on from; the network has been given their average."""
        self._resumed = checkpoint.get(TRAINED, {})

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Begin with the weights of the start, or go on."""
        weights = _floating(pl_module)
        self._average = {name: value.clone() for name, value in weights.items()}
        self._is_in_place, self._updated_at = False, trainer.global_step
        for name, value in self._resumed.items():
            if name in weights:
                weights[name].copy_(value)
        self._resumed = {}

    @torch.no_grad()
    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Move the average after each step."""
        step = trainer.global_step
        if step == self._updated_at:
            return
        self._updated_at = step
        move = get_ema_multi_avg_fn(min(self._decay, (1 + step) / (10 + step)))
        weights = _floating(pl_module)
        move([*self._average.values()], [weights[name] for name in self._average], None)

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let the average be scored."""
        self._exchange(pl_module, in_place=True)
        average_statistics(pl_module)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Go on with the weights that are trained."""
        self._exchange(pl_module, in_place=False)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave the average in the network."""
        self._exchange(pl_module, in_place=True)

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Put the average where weights are looked for, and what is trained beside it."""
        if not self._average:
            return
        if not self._is_in_place and dist.is_available() and dist.is_initialized():
            self._exchange(pl_module, in_place=True)
            average_statistics(pl_module)
            self._exchange(pl_module, in_place=False)
        state = checkpoint["state_dict"]
        here, there = {name: state[name] for name in self._average}, dict(self._average)
        average, trained = (here, there) if self._is_in_place else (there, here)
        checkpoint["state_dict"] = {**state, **average}
        checkpoint[TRAINED] = trained

    @torch.no_grad()
    def _exchange(self, pl_module: pl.LightningModule, *, in_place: bool) -> None:
        """Exchange the network's weights and those kept here, unless they are where they should be."""
        if not self._average or self._is_in_place == in_place:
            return
        self._is_in_place = in_place
        weights = _floating(pl_module)
        ours, theirs = [*self._average.values()], [weights[name] for name in self._average]
        before = [value.clone() for value in theirs]
        torch._foreach_copy_(theirs, ours)
        torch._foreach_copy_(ours, before)


def _floating(module: pl.LightningModule) -> dict[str, Tensor]:
    """Return weights and statistics by name, the tensors themselves; counters are none."""
    return {name: value for name, value in module.state_dict().items() if value.is_floating_point()}
