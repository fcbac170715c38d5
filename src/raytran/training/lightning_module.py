# SPDX-License-Identifier: Apache-2.0
"""The LightningModule: wires batch → model → loss → log, validation scores, optimiser. No maths."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torchmetrics import MeanMetric, Metric

from raytran.losses.total import TotalLoss
from raytran.model import RayTran, Traced, inputs_of
from raytran.structs import RawScene, SceneBatch
from raytran.training.cast_weights import weights_cast_together
from raytran.training.health_signals import gradient_norms
from raytran.training.loggers import is_logged_step
from raytran.training.optim import Optimization
from raytran.training.ranks import mean_over_ranks
from raytran.training.scores import SceneScores
from raytran.training.stage import Stage
from raytran.training.weight_layout import lay_channels_last


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
        map_boxes: with mean average precision among the validation scores, see ``SceneScores``.
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
        map_boxes: str | None = None,
    ) -> None:
        super().__init__()
        self.model = model
        self.loss = loss
        self.stage = stage
        self.optimization = optimization
        self.scores = SceneScores(
            tasks=stage.tasks, map_boxes=map_boxes, metrics=metrics, classes=model.classes
        )
        self._compiled = torch.compile(model.forward) if compiled else None
        self._val_losses: dict[str, MeanMetric] = {}
        self._gradient_norms: dict[str, Tensor] | None = None

    def configure_model(self) -> None:
        """Lay out weights for a GPU, before ranks and optimiser look at them."""
        if self.trainer.strategy.root_device.type not in ("cpu", "mps"):
            lay_channels_last(self.model)

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
        several = torch.distributed.is_available() and torch.distributed.is_initialized()
        over_ranks = mean_over_ranks if several else None
        with self._weights_for_a_step():
            # A step waits for its device once: where queries are matched, and else for the number of pairs.
            traced = self._trace(batch, wait=not {"objects", "shape"} & set(self.stage.terms))
            raw = self._run_model(batch, traced._replace(fits=None))
            losses = self._losses(raw, batch, mean_over_ranks=over_ranks)
        if traced.fits is not None:
            # A step that lacks pairs is skipped, like one that is not finite.
            losses["total"] = torch.where(traced.fits, losses["total"], math.nan)
        means = torch.stack([value.detach() for value in losses.values()])
        if over_ranks is not None:
            means = over_ranks(means)
        logged = dict(zip(losses, means, strict=True))
        # Lightning copies each value twice, also in steps in which none is shown: on a GPU 54 launches.
        if self.device.type == "cpu" or is_logged_step(self.trainer):
            for name, value in logged.items():
                self.log(f"train/{name}", value)
        objects = None if raw.objects is None else raw.objects[-1].detach()
        return {"loss": losses["total"], "losses": logged, "objects": objects}

    def validation_step(self, batch: SceneBatch, batch_idx: int) -> None:
        """Collect the losses and the scores, in float32 also under autocast."""
        raw = self._run_model(batch, self._trace(batch))
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
        """Return AdamW over what the stage trains, with its schedule.

        Fused, all parameters in one pass, but not in 16-mixed, whose scaler lets no fused optimiser clip, nor
        on Apple's GPUs, where nobody has tried it.
        """
        scales = getattr(self.trainer.precision_plugin, "scaler", None) is not None
        fused = self.device.type != "mps" and not scales
        steps = int(self.trainer.estimated_stepping_batches)
        return self.optimization.build(self.model.parameters(), steps, fused=fused)

    def gradient_norms(self) -> dict[str, Tensor]:
        """Return the norms of the step's gradients by part of the network, and of ``all``; computed once."""
        if self._gradient_norms is None:
            self._gradient_norms = gradient_norms(self.model)
        return self._gradient_norms

    def configure_gradient_clipping(
        self,
        optimizer: Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the norm of all gradients; a fused optimiser does it, as it reads them.

        Lightning's own clipping refuses fused optimisers under autocast.
        """
        if gradient_clip_algorithm not in (None, "norm"):
            self.clip_gradients(optimizer, gradient_clip_val, gradient_clip_algorithm)
        elif gradient_clip_val and self.gradient_norms():
            norm = self.gradient_norms()["all"]
            if optimizer.defaults.get("fused"):
                scale = ((norm + 1e-6) / gradient_clip_val).clamp(min=1.0)
                vars(optimizer)["grad_scale"] = scale.float()  # also of parameters in float64
            else:
                nn.utils.clip_grads_with_norm_(self.model.parameters(), gradient_clip_val, norm)
        self._gradient_norms = None

    def _trace(self, batch: SceneBatch, *, wait: bool = True) -> Traced:
        new_cameras = inputs_of(batch)["new_cameras"]
        return self.model.trace_views(
            batch.views, grid_center=batch.grid_center, new_cameras=new_cameras, wait=wait
        )

    def _run_model(self, batch: SceneBatch, traced: Traced | None = None) -> RawScene:
        run = self._compiled or self.model
        return run(**inputs_of(batch), tasks=self.stage.tasks, traced=traced)

    def _weights_for_a_step(self) -> AbstractContextManager[None]:
        """Cast weights together under autocast, where no compiler does and no block is computed twice."""
        twice = getattr(self.model.backbone, "checkpoint_blocks", False)
        if not torch.is_autocast_enabled(self.device.type) or self._compiled is not None or twice:
            return nullcontext()
        return weights_cast_together(self.model, self.device.type)

    def _losses(self, raw: RawScene, batch: SceneBatch, **options: Any) -> dict[str, Tensor]:
        for objects in batch.objects or ():
            objects.check_classes(self.model.classes, "the network")
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
