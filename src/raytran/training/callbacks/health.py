# SPDX-License-Identifier: Apache-2.0
"""Steps that would spoil the weights are skipped; early signs of a run that goes wrong are logged."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.optim import Optimizer

from raytran.errors import NonFiniteError
from raytran.structs import RawObjects, SceneBatch
from raytran.training.health_signals import RunningStatistics, gradient_norms, slot_signals
from raytran.training.lightning_module import Reconstruction
from raytran.training.loggers import was_logged_step
from raytran.training.ranks import mean_over_ranks

_log = logging.getLogger(__name__)


class Health(pl.Callback):
    """Keeps numbers that are not finite out of the network, and logs signs of how training goes.

    A step whose loss or gradient is not finite changes nothing: neither weights, nor the optimiser's moments,
    nor the running statistics of batch norms. It counts as a step, so that schedule and data go on. The ranks
    skip the same steps, because they judge by their mean loss and by the reduced gradients.

    Args:
        max_skipped: steps skipped in a row after which the run gives up. 16-bit training skips up to about
            twenty at its start, until its scaler has found the range.
    """

    def __init__(self, *, max_skipped: int) -> None:
        self._max_skipped = max_skipped
        self._skipped = 0
        self._in_a_row = 0
        self._loss: Tensor | None = None
        self._losses: list[Mapping[str, Tensor]] = []
        self._norms: dict[str, float] = {}
        self._statistics: RunningStatistics | None = None

    def state_dict(self) -> dict[str, Any]:
        """Return the counts, for the checkpoint."""
        return {"skipped": self._skipped, "in_a_row": self._in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting."""
        self._skipped, self._in_a_row = int(state_dict["skipped"]), int(state_dict["in_a_row"])

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Find the batch norms whose statistics a skipped step must not change."""
        self._statistics = RunningStatistics(pl_module)

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Remember the running statistics at the first batch of a step."""
        if batch_idx % trainer.accumulate_grad_batches == 0 and self._statistics is not None:
            self._statistics.save()

    def on_before_backward(self, trainer: pl.Trainer, pl_module: pl.LightningModule, loss: Tensor) -> None:
        """Add up this rank's losses of the batches of a step: an infinite one may have finite gradients."""
        loss = loss.detach()
        self._loss = loss if self._loss is None else self._loss + loss

    def on_before_optimizer_step(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Optimizer
    ) -> None:
        """Skip the step if its loss or a gradient is not finite."""
        if self._loss is None:
            return
        loss = mean_over_ranks(self._loss.float())
        self._loss = None
        norms = gradient_norms(pl_module.get_submodule("model"))
        values = torch.stack([loss, *norms.values()]).tolist()  # the one wait of a step for the device
        self._norms = dict(zip(norms, values[1:], strict=True))
        if all(map(math.isfinite, values)):
            self._in_a_row = 0
            return
        optimizer.zero_grad(set_to_none=True)  # an optimiser leaves parameters without gradients as they are
        if self._statistics is not None:
            self._statistics.restore()
        self._skipped += 1
        self._in_a_row += 1

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log after the last batch of a step, and end the run if too many steps in a row were skipped.

        Raises:
            NonFiniteError: too many steps have been skipped in a row.
        """
        self._losses.append(outputs["losses"])
        if (batch_idx + 1) % trainer.accumulate_grad_batches:
            return
        if self._in_a_row:
            self._report_skipped(trainer)
        if was_logged_step(trainer):
            pl_module.log_dict(self._signals(pl_module, outputs["objects"], batch))
        self._losses.clear()

    def _signals(
        self, module: pl.LightningModule, objects: RawObjects | None, batch: SceneBatch
    ) -> dict[str, float]:
        """Return what is logged of a step: counts, gradients by part, how the queries are used."""
        signals = {"health/skipped_steps": float(self._skipped)}
        signals |= {f"health/gradient/{part}": norm for part, norm in self._norms.items()}
        signals["health/gradient/all"] = math.hypot(*self._norms.values())
        if objects is not None and batch.objects is not None and isinstance(module, Reconstruction):
            found = slot_signals(objects, batch.objects, module.loss.matcher)
            signals |= {f"health/{name}": float(value) for name, value in found.items()}
        return signals

    def _report_skipped(self, trainer: pl.Trainer) -> None:
        """Warn of a skipped step; end the run at the last one allowed."""
        step, reason = trainer.global_step - 1, self._reason()
        _log.warning(
            "step %d skipped: %s (%d in a row, at most %d)",
            *(step, reason, self._in_a_row, self._max_skipped - 1),
        )
        if self._in_a_row >= self._max_skipped:
            self._give_up(trainer, step, reason)

    def _reason(self) -> str:
        """Say which terms of the loss are not finite, or else which gradients."""
        terms = {
            name for losses in self._losses for name, value in losses.items() if not value.isfinite().all()
        }
        if terms:
            return f"the loss ({', '.join(sorted(terms - {'total'})) or 'total'})"
        parts = [part for part, norm in self._norms.items() if not math.isfinite(norm)]
        return f"the gradient of {', '.join(parts)}"

    def _give_up(self, trainer: pl.Trainer, step: int, reason: str) -> None:
        trainer.strategy.barrier()  # all ranks have logged before the first one to leave ends the others
        if trainer.global_rank:
            raise SystemExit(1)  # the first rank says it for all
        exact = str(trainer.precision) == "32-true"
        remedy = "" if exact else " or try trainer.precision=32-true,"
        raise NonFiniteError(
            f"{self._in_a_row} steps in a row were not finite, the last one step {step} ({reason}): lower "
            f"optimizer.learning_rate,{remedy} and go on from a checkpoint before that"
        )
