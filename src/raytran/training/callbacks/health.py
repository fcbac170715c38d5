# SPDX-License-Identifier: Apache-2.0
"""Steps that would spoil the weights are skipped; early signs of a run that goes wrong are logged."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.optim import Optimizer

from raytran.errors import CheckpointError, NonFiniteError
from raytran.structs import SceneBatch
from raytran.training.health_signals import RunningStatistics, gradient_norms, slot_signals
from raytran.training.reconstruction import Reconstruction
from raytran.training.replay_file import write_replay

_log = logging.getLogger(__name__)


class Health(pl.Callback):
    """Keeps numbers that are not finite out of the network, and watches those that are.

    A step whose loss or gradient is not finite changes nothing: neither weights, nor the optimiser's moments,
    nor the running statistics of batch norms. It counts as a step, so that schedule and data go on. The ranks
    need not ask each other: all see the same mean loss and the same reduced gradients.

    Args:
        replay: file for the last batches when the run gives up; ranks but the first add their number.
        max_skipped: steps skipped in a row after which the run gives up. 16-bit training skips up to about
            twenty at its start, until its scaler has found the range.
        card: plain Python that every checkpoint carries.
    """

    def __init__(self, replay: Path, *, max_skipped: int, card: Mapping[str, Any]) -> None:
        self._replay = replay
        self._max_skipped = max_skipped
        self._card = dict(card)
        self._skipped = 0
        self._in_a_row = 0
        self._batches: list[SceneBatch] = []
        self._loss: Tensor | None = None
        self._statistics: RunningStatistics | None = None

    def state_dict(self) -> dict[str, Any]:
        """Return the counts, for the checkpoint."""
        return {"skipped": self._skipped, "in_a_row": self._in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting."""
        self._skipped, self._in_a_row = int(state_dict["skipped"]), int(state_dict["in_a_row"])

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Find what would have to be put back."""
        self._statistics = RunningStatistics(pl_module)

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Keep what a step begins with."""
        if batch_idx % trainer.accumulate_grad_batches == 0:
            self._batches.clear()
            self._loss = None
            if self._statistics is not None:
                self._statistics.keep()
        self._batches.append(batch)

    def on_after_backward(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Add up the losses of the batches of a step."""
        if isinstance(pl_module, Reconstruction) and pl_module.outcome is not None:
            loss = pl_module.outcome.losses["total"]
            self._loss = loss if self._loss is None else self._loss + loss

    def on_before_optimizer_step(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Optimizer
    ) -> None:
        """Skip the step if it must be; else log the signals at the steps at which the losses are logged.

        Raises:
            NonFiniteError: too many steps have been skipped in a row.
        """
        if not isinstance(pl_module, Reconstruction) or self._loss is None:
            return
        norms = gradient_norms(pl_module.model)
        # One wait for the device for all of them.
        loss, *values = torch.stack([self._loss.float(), *norms.values()]).tolist()
        by_part = dict(zip(norms, values, strict=True))
        if math.isfinite(loss) and all(map(math.isfinite, values)):
            self._in_a_row = 0
        else:
            self._skip(trainer, pl_module, optimizer, _not_finite(pl_module, loss, by_part))
        # Lightning has no public word for it; its own callbacks ask like this too.
        if trainer._logger_connector.should_update_logs:
            self._log_signals(pl_module, by_part)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Let go of the batches of a step that is done."""
        if (batch_idx + 1) % trainer.accumulate_grad_batches == 0:
            self._batches.clear()

    def _log_signals(self, module: Reconstruction, norms: Mapping[str, float]) -> None:
        signals = {"health/skipped_steps": float(self._skipped)}
        signals |= {f"health/gradient/{part}": value for part, value in norms.items()}
        signals["health/gradient/all"] = math.hypot(*norms.values())
        outcome, targets = module.outcome, self._batches[-1].objects
        if outcome is not None and outcome.objects is not None and targets is not None:
            found = slot_signals(outcome.objects, targets, module.loss.matcher)
            signals |= {f"health/{name}": float(value) for name, value in found.items()}
        module.log_dict(signals)

    def _skip(self, trainer: pl.Trainer, module: Reconstruction, optimizer: Optimizer, reason: str) -> None:
        optimizer.zero_grad(set_to_none=True)  # an optimiser leaves parameters without gradients as they are
        if self._statistics is not None:
            self._statistics.restore()
        self._skipped += 1
        self._in_a_row += 1
        step, row = trainer.global_step, self._in_a_row
        _log.warning(
            "step %d skipped: %s (%d in a row, at most %d)", *(step, reason, row, self._max_skipped - 1)
        )
        if row >= self._max_skipped:
            self._give_up(trainer, module, reason)

    def _give_up(self, trainer: pl.Trainer, module: Reconstruction, reason: str) -> None:
        rank, step = trainer.global_rank, trainer.global_step
        path = self._replay.with_stem(f"{self._replay.stem}-{rank}") if rank else self._replay
        hint = f"python -m raytran.replay {path} shows where the numbers go wrong"
        try:
            write_replay(
                path,
                module.model,
                self._batches,
                card=self._card,
                step=step,
                precision=str(trainer.precision),
                scale=_loss_scale(trainer),
            )
        except CheckpointError as error:
            hint = str(error)
        trainer.strategy.barrier()  # every rank has written before the first one to leave ends the others
        if rank:
            raise SystemExit(1)  # the first rank says it for all
        exact = str(trainer.precision) == "32-true"
        remedy = "" if exact else " or try trainer.precision=32-true,"
        raise NonFiniteError(
            f"{self._in_a_row} steps in a row were not finite, the last one step {step} ({reason}): lower "
            f"optimizer.learning_rate,{remedy} and go on from a checkpoint before that; {hint}"
        )


def _loss_scale(trainer: pl.Trainer) -> float | None:
    """Return what the loss of this step was multiplied by, None in other precisions than 16-mixed."""
    scaler = getattr(trainer.precision_plugin, "scaler", None)
    return None if scaler is None else float(scaler.get_scale())


def _not_finite(module: Reconstruction, loss: float, norms: Mapping[str, float]) -> str:
    """Say what is not finite."""
    outcome = module.outcome
    if math.isfinite(loss) or outcome is None:
        parts = [part for part, value in norms.items() if not math.isfinite(value)]
        return f"the gradient of {', '.join(parts)}"
    terms = [name for name, value in outcome.losses.items() if not math.isfinite(float(value))]
    return f"the loss ({', '.join(term for term in terms if term != 'total') or 'total'})"
