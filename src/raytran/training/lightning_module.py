# SPDX-License-Identifier: Apache-2.0
"""The LightningModule: wires batch → model → loss → log, validation scores, optimiser. No maths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor
from torchmetrics import MeanMetric, Metric

from raytran.losses.total import TotalLoss
from raytran.model import RayTran, inputs_of
from raytran.structs import RawScene, SceneBatch
from raytran.training.optim import Optimization
from raytran.training.ranks import mean_over_ranks
from raytran.training.scores import SceneScores
from raytran.training.stage import Stage


class Reconstruction(pl.LightningModule):
    """Fits the model in one stage of the curriculum.

    Args:
        model: the network.
        loss: all loss terms; the stage says which count.
        stage: what trains.
        optimization: optimiser and schedule.
        compiled: run the model through ``torch.compile``. What is compiled is the function, not the module,
            so that weights keep their names.
        metrics: validation scores besides ours, by name, see ``SceneScores``.
    """

    def __init__(
        self,
        *,
        model: RayTran,
        loss: TotalLoss,
        stage: Stage,
        optimization: Optimization,
        compiled: bool = False,
        metrics: Mapping[str, Metric] | None = None,
    ) -> None:
        super().__init__()
        self.model = model
        self.loss = loss
        self.stage = stage
        self.optimization = optimization
        self.scores = SceneScores(tasks=stage.tasks, metrics=metrics)
        self._compiled = torch.compile(model.forward) if compiled else None
        self._val_losses: dict[str, MeanMetric] = {}

    def transfer_batch_to_device(
        self, batch: SceneBatch, device: torch.device, dataloader_idx: int
    ) -> SceneBatch:
        """Return the batch on the device; out of page-locked memory, where loaders put it, without a wait.

        Lightning does so with tensors alone.
        """
        return batch.to(device, non_blocking=device.type not in ("cpu", "mps"))

    def training_step(self, batch: SceneBatch, batch_idx: int) -> dict[str, Any]:
        """Run the network on a batch and log the terms of the loss, means over all ranks.

        Returns:
            ``loss``: the scalar to minimise.
            ``losses``: terms and ``total``, means over the ranks, without a graph.
            ``objects``: the last decoder layer's ``RawObjects`` without a graph; None in stages without them.
            Lightning hands all of it to the callbacks' ``on_train_batch_end``.
        """
        raw = self._run_model(batch)
        several = torch.distributed.is_available() and torch.distributed.is_initialized()
        over_ranks = mean_over_ranks if several else None
        losses = self._losses(raw, batch, mean_over_ranks=over_ranks)
        means = torch.stack([value.detach() for value in losses.values()])
        if over_ranks is not None:
            means = over_ranks(means)
        logged = dict(zip(losses, means, strict=True))
        for name, value in logged.items():
            self.log(f"train/{name}", value, prog_bar=name == "total")
        objects = None if raw.objects is None else raw.objects[-1].detach()
        return {"loss": losses["total"], "losses": logged, "objects": objects}

    def validation_step(self, batch: SceneBatch, batch_idx: int) -> None:
        """Collect the losses and the scores, in float32 also under autocast."""
        raw = self._run_model(batch)
        losses = self._losses(raw, batch)
        weight = 0 if self._is_repeated(batch_idx) else len(batch.scene_id)
        for name, value in losses.items():
            mean = self._val_losses.setdefault(name, MeanMetric().to(self.device))
            mean.update(value, weight)
        if weight:
            with torch.autocast(self.device.type, enabled=False):
                self.scores.update(batch, self.model.decode(raw, batch.scene_id, with_shapes=False))

    def on_validation_epoch_end(self) -> None:
        """Log the losses and the scores over all validation scenes."""
        losses = {name: mean.compute() for name, mean in self._val_losses.items()}
        self.log_dict({f"val/{name}": value for name, value in (losses | self.scores.compute()).items()})
        self.scores.reset()
        self._val_losses.clear()

    def configure_optimizers(self) -> Any:
        """Return AdamW over what the stage trains, with its schedule."""
        return self.optimization.build(self.model.parameters(), int(self.trainer.estimated_stepping_batches))

    def _run_model(self, batch: SceneBatch) -> RawScene:
        run, inputs = self._compiled or self.model, inputs_of(batch)
        traced = self.model.trace_views(
            batch.views, grid_center=batch.grid_center, new_cameras=inputs["new_cameras"]
        )
        return run(**inputs, tasks=self.stage.tasks, traced=traced)

    def _losses(self, raw: RawScene, batch: SceneBatch, **options: Any) -> dict[str, Tensor]:
        return self.loss(
            raw, batch, terms=self.stage.terms, decode_shapes=self.model.decode_shapes, **options
        )

    def _is_repeated(self, batch_idx: int) -> bool:
        """Return whether a validation scene is a repetition that only fills up the last ranks' share.

        Validation batches hold one scene each, so that the number of the batch tells the scene.
        """
        place = batch_idx * self.trainer.world_size + self.trainer.global_rank
        loader: Any = self.trainer.val_dataloaders
        return place >= len(loader.dataset)
