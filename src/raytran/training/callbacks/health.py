# SPDX-License-Identifier: Apache-2.0
"""Steps that would spoil the weights are skipped; early signs of a run that goes wrong are logged."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.optim import Optimizer

from raytran.errors import NonFiniteError
from raytran.structs import HostCopy, RawObjects, SceneBatch
from raytran.training.health_signals import RunningStatistics, slot_signals
from raytran.training.lightning_module import Reconstruction
from raytran.training.loggers import was_logged_step
from raytran.training.ranks import mean_over_ranks

_log = logging.getLogger(__name__)


@dataclass
class _Step:
    """What is known of a step.

    Attributes:
        number: of the step.
        parts: whose gradients have norms.
        found: the loss and these norms.
        losses: terms of the loss of each of its batches.
    """

    number: int
    parts: Sequence[str]
    found: HostCopy
    losses: list[Mapping[str, Tensor]] = field(default_factory=list)

    def norms(self) -> dict[str, float]:
        """Return the norms of the gradients by part."""
        return dict(zip(self.parts, self.found.values().tolist()[1:], strict=True))

    def is_finite(self) -> bool:
        """Say whether the loss and all gradients are finite."""
        return all(map(math.isfinite, self.found.values().tolist()))

    def reason(self) -> str:
        """Say which terms of the loss are not finite, or else which gradients."""
        terms = {
            name for losses in self.losses for name, value in losses.items() if not value.isfinite().all()
        }
        if terms == {"total"}:
            return "the loss, or more pairs of pixels and voxels than twice those of any step before"
        if terms:
            return f"the loss ({', '.join(sorted(terms - {'total'}))})"
        parts = [part for part, norm in self.norms().items() if part != "all" and not math.isfinite(norm)]
        return f"the gradient of {', '.join(parts)}"


class Health(pl.Callback):
    """Keeps numbers that are not finite out of the network, and logs signs of how training goes.

    A step whose loss or gradient is not finite changes nothing: neither weights, nor the optimiser's moments,
    nor the running statistics of batch norms. It counts as a step, so that schedule and data go on. The ranks
    skip the same steps, because they judge by their mean loss and by the reduced gradients.

    A fused optimiser skips a step by itself. The host then does not wait to know it: it counts the step after
    the next one, or when something is logged, validated or saved.

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
        self._step: _Step | None = None
        self._unread: _Step | None = None
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
        if self._loss is None or not isinstance(pl_module, Reconstruction):
            return
        loss = mean_over_ranks(self._loss.float())
        self._loss = None
        norms = pl_module.gradient_norms()
        values = torch.stack([loss, *norms.values()])
        self._step = _Step(trainer.global_step, list(norms), HostCopy(values))
        if optimizer.defaults.get("fused"):
            is_bad = (0.0 * values).sum().isnan()
            vars(optimizer)["found_inf"] = is_bad.float()
            if self._statistics is not None:
                self._statistics.restore(where=is_bad)
        elif not self._step.is_finite():  # here the host waits
            optimizer.zero_grad(set_to_none=True)  # parameters without gradients are left as they are
            if self._statistics is not None:
                self._statistics.restore()

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log after the last batch of a step, and end the run if too many steps in a row were skipped.

        Raises:
            NonFiniteError: too many steps have been skipped in a row.
        """
        self._losses.append(outputs["losses"])
        if (batch_idx + 1) % trainer.accumulate_grad_batches or self._step is None:
            return
        self._read(trainer)
        self._step.losses, self._losses = self._losses, []
        step, self._unread = self._step, self._step
        if was_logged_step(trainer) or not trainer.optimizers[0].defaults.get("fused"):
            self._read(trainer)
        if was_logged_step(trainer):
            pl_module.log_dict(self._signals(pl_module, step, outputs["objects"], batch))

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Count the last step before it is judged or saved."""
        self._read(trainer)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Count the last step."""
        self._read(trainer)

    def _read(self, trainer: pl.Trainer) -> None:
        """Count a step whose numbers are on their way, if there is one."""
        step, self._unread = self._unread, None
        if step is None:
            return
        if step.is_finite():
            self._in_a_row = 0
            return
        self._skipped += 1
        self._in_a_row += 1
        self._report_skipped(trainer, step)

    def _signals(
        self, module: pl.LightningModule, step: _Step, objects: RawObjects | None, batch: SceneBatch
    ) -> dict[str, float]:
        """Return what is logged of a step: counts, gradients by part, how the queries are used."""
        signals = {"health/skipped_steps": float(self._skipped)}
        signals |= {f"health/gradient/{part}": norm for part, norm in step.norms().items()}
        if objects is not None and batch.objects is not None and isinstance(module, Reconstruction):
            found = slot_signals(objects, batch.objects, module.loss.matcher)
            signals |= {f"health/{name}": float(value) for name, value in found.items()}
        return signals

    def _report_skipped(self, trainer: pl.Trainer, step: _Step) -> None:
        """Warn of a skipped step; end the run at the last one allowed."""
        reason = step.reason()
        _log.warning(
            "step %d skipped: %s (%d in a row, at most %d)",
            *(step.number, reason, self._in_a_row, self._max_skipped - 1),
        )
        if self._in_a_row >= self._max_skipped:
            self._give_up(trainer, step.number, reason)

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
