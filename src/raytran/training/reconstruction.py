# SPDX-License-Identifier: Apache-2.0
"""The LightningModule: wires batch → model → loss → log, validation scores, optimiser. No maths."""

from __future__ import annotations

from typing import Any, Self

import lightning.pytorch as pl
import torch
from torch import Tensor

from raytran.losses.total import TotalLoss
from raytran.model import RayTran
from raytran.training.optim import Optimization
from raytran.training.scores import SceneScores
from raytran.training.stage import Stage
from raytran.types import RawScene, SceneBatch


class Reconstruction(pl.LightningModule):
    """Fits the model in one stage of the curriculum.

    Args:
        model: the network.
        loss: all loss terms; the stage says which count.
        stage: what trains.
        optimization: optimiser and schedule.
        compiled: run the model through ``torch.compile``. What is compiled is the function, not the module,
            so that weights keep their names.
    """

    def __init__(
        self,
        *,
        model: RayTran,
        loss: TotalLoss,
        stage: Stage,
        optimization: Optimization,
        compiled: bool = False,
    ) -> None:
        super().__init__()
        self.model = model
        self.loss = loss
        self.stage = stage
        self.optimization = optimization
        self.scores = SceneScores(tasks=stage.tasks)
        self._forward = torch.compile(model.forward) if compiled else model.forward

    def train(self, mode: bool = True) -> Self:
        """Set the mode; frozen parts stay in evaluation mode whatever Lightning asks for."""
        super().train(mode)
        self.stage.set_mode(self.model)
        return self

    def training_step(self, batch: SceneBatch, batch_idx: int) -> Tensor:
        """Return the loss to minimise."""
        return self._losses(self._run_model(batch), batch, "train")["total"]

    def validation_step(self, batch: SceneBatch, batch_idx: int) -> None:
        """Log the losses and collect the scores."""
        raw = self._run_model(batch)
        self._losses(raw, batch, "val")
        self.scores.update(batch, self.model.decode(raw, batch.scene_id, with_shapes=False))

    def on_validation_epoch_end(self) -> None:
        """Log the scores over all validation scenes."""
        for name, value in self.scores.compute().items():
            self.log(f"val/{name}", value)
        self.scores.reset()

    def configure_optimizers(self) -> Any:
        """Return AdamW over what the stage trains, with its schedule."""
        return self.optimization.build(self.model.parameters(), int(self.trainer.estimated_stepping_batches))

    def _run_model(self, batch: SceneBatch) -> RawScene:
        return self._forward(batch.views, tasks=self.stage.tasks, grid_center=batch.grid_center)

    def _losses(self, raw: RawScene, batch: SceneBatch, split: str) -> dict[str, Tensor]:
        losses = self.loss(
            raw,
            batch,
            terms=self.stage.terms,
            decode_shapes=self.model.decode_shapes,
            num_objects=self._objects_per_rank(batch) if split == "train" else None,
        )
        is_train = split == "train"
        for name, value in losses.items():
            self.log(
                f"{split}/{name}",
                value.detach(),
                prog_bar=is_train and name == "total",
                sync_dist=not is_train,
                batch_size=len(batch.scene_id),
            )
        return losses

    def _objects_per_rank(self, batch: SceneBatch) -> Tensor | None:
        """Return the mean over the ranks, so that DDP's mean of gradients counts all objects alike."""
        if batch.objects is None:
            return None
        count = torch.tensor(float(sum(len(objects) for objects in batch.objects)), device=self.device)
        return self.trainer.strategy.reduce(count, reduce_op="mean").clamp(min=1)
