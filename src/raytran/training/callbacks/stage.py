# SPDX-License-Identifier: Apache-2.0
"""What a stage of the curriculum is in a fit: where weights come from, what is frozen, what it hands on."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from torch import nn

from raytran.checkpoints.load import classes_of, fresh_parts, load_weights
from raytran.checkpoints.metadata import DataIdentity
from raytran.errors import CheckpointError
from raytran.model import RayTran
from raytran.training.lightning_module import Reconstruction
from raytran.training.stage import Stage, is_within

_log = logging.getLogger(__name__)


class StageCallback(pl.Callback):
    """Owns what a stage is, one callback for one fit.

    Before the fit it refuses a parent that has not learned its task. In ``setup``, before
    DistributedDataParallel wraps the model, it takes the parent's weights and freezes what the stage does not
    train; before every step it sets the modes of frozen parts and frozen norms; every checkpoint says which
    stage it is of and what it started from; and at the end it is told which stages may start from it.

    Freezing is a pure function of the config: nothing is remembered, nothing changes during the fit, so a
    resumed run is frozen like a fresh one, and DDP sees from the start the parameters whose gradients it must
    reduce. (Unfreezing inside a DDP fit desynchronises the ranks silently; ``BaseFinetuning`` re-freezes on
    resume.)

    Args:
        parent: path and content of the checkpoint whose weights a new run starts from; None for a run that
            starts at random or is resumed.
        stage: the stage, to check the parent before anything is built; needed with ``parent``.
        check: what is asked of the parent, see ``check_parent``.
        parent_of_resumed: what a resumed run's checkpoint says of its parent.
        warnings: what anybody who uses the weights should know of them.
        next_stages: stages that build on this one.

    Raises:
        CheckpointError: the parent is of another stage, or has not learned its task.
    """

    def __init__(
        self,
        *,
        parent: tuple[Path, Mapping[str, Any]] | None = None,
        stage: Stage | None = None,
        check: str = "scores",
        parent_of_resumed: Mapping[str, Any] | None = None,
        warnings: Sequence[str] = (),
        next_stages: Sequence[Stage] = (),
    ) -> None:
        self._modes: list[tuple[nn.Module, bool]] = []
        self._weights = parent
        self._next_stages = next_stages
        self.parent = None if parent_of_resumed is None else dict(parent_of_resumed)
        self.warnings = list(warnings)
        if parent is not None and stage is not None:
            found = Parent.of(*parent)
            check_parent(found, stage, check)
            self.parent = found.as_plain()
            self.warnings = list(parent[1].get("warnings") or ())

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Take the parent's weights and freeze parameters, before DistributedDataParallel wraps the model."""
        if not isinstance(pl_module, Reconstruction):
            return
        if self._weights is not None and stage == "fit":
            self._take_weights(pl_module, *self._weights)
            self._weights = None
        pl_module.stage.freeze(pl_module.model)

    def _take_weights(self, module: Reconstruction, path: Path, content: Mapping[str, Any]) -> None:
        model, stage = module.model, module.stage
        for part in stage.restarted_parts:
            _log.info("%s starts at random, as stage.restarted_parts asks", part)
        fresh = fresh_parts(model, content, stage.fresh_parts)
        of_classes = set(model.class_layers())
        for part in fresh:
            if part not in of_classes:
                _log.info("%s starts at random: its parent has none that fits, and trained none", part)
        difference = model.classes.difference(classes_of(content))
        if difference is not None:
            check_class_layers(model, stage, path, difference)
            _log.info(
                "what tells the %d classes apart starts at random: its parent has %s",
                len(model.classes),
                difference,
            )
        load_weights(module.model, content, path, fresh=[*fresh, *stage.restarted_parts])

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

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Say which stage the weights are of and what they started from, which the next stage asks for."""
        if isinstance(pl_module, Reconstruction):
            checkpoint["stage"] = pl_module.stage.name
            checkpoint["parent"] = self.parent
            checkpoint["warnings"] = self.warnings

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log whether the stages that build on this one may start from it."""
        if not isinstance(pl_module, Reconstruction) or not trainer.is_global_zero:
            return
        scores = {name: float(value) for name, value in trainer.callback_metrics.items()}
        done = Parent("this run", pl_module.stage.name, trainer.global_step, scores)
        for following in self._next_stages:
            objection = not_learned(done, following)
            if objection is None:
                _log.info("%s may start from it", following.name)
            else:
                _log.warning("%s will refuse to start from it: it %s", following.name, objection)


@dataclass(frozen=True)
class Parent:
    """Where the first weights of a run come from.

    Attributes:
        path: of the checkpoint.
        stage: name of its stage.
        step: optimiser steps it had taken.
        scores: its last validation, by name.
        data: what it was trained on, see ``DataIdentity.as_plain``; None if it does not say.
    """

    path: str
    stage: str
    step: int
    scores: dict[str, float]
    data: dict[str, Any] | None = None

    @staticmethod
    def of(path: Path, checkpoint: Mapping[str, Any]) -> Parent:
        """Return what is to be remembered of a parent.

        Raises:
            CheckpointError: the file says nothing sensible.
        """
        try:
            scores = {name: float(value) for name, value in checkpoint.get("scores", {}).items()}
            known = DataIdentity.of_checkpoint(checkpoint)
            step, data = int(checkpoint.get("global_step", 0)), None if known is None else known.as_plain()
            return Parent(str(path), checkpoint["stage"], step, scores, data)
        except (AttributeError, TypeError, ValueError) as error:
            raise CheckpointError(f"{path} says odd things of itself ({error}): it is damaged") from error

    def as_plain(self) -> dict[str, Any]:
        """Return plain Python, to be written into a checkpoint."""
        return asdict(self)


def check_class_layers(model: RayTran, stage: Stage, path: Path, difference: str) -> None:
    """Raise if a stage needs what tells classes apart, but would neither get it from its parent nor train it.

    Args:
        model: the network.
        stage: the stage to train.
        path: the parent.
        difference: how its classes differ, see ``Classes.difference``.

    Raises:
        CheckpointError: it would not.
    """
    untrained = [layer for layer in model.class_layers() if not is_within(layer, stage.trainable)]
    if untrained and "objects" in stage.tasks:
        raise CheckpointError(
            f"{path} has {difference}, and {stage.name} does not train what tells classes apart: "
            f"train experiment={stage.parent_experiment} with these classes first"
        )


def check_parent(parent: Parent, stage: Stage, check: str) -> None:
    """Raise unless ``parent`` is of a stage that ``stage`` builds on, or of its own, and knows its task.

    Args:
        parent: the checkpoint to start from.
        stage: the stage to train.
        check: ``scores``, or ``stage`` to leave out its task, or ``none`` to warn only.

    Raises:
        CheckpointError: the parent is of another stage or its validation score is too low.
    """
    if stage.parent is None or parent.stage in (stage.name, *stage.other_parents):
        return
    again = f"train experiment={stage.parent_experiment}"
    if parent.stage != stage.parent:
        objection = f"{parent.path} is of {parent.stage}, but {stage.name} builds on {stage.parent}"
        if check == "none":
            _log.warning("%s", objection)
            return
        raise CheckpointError(f"{objection}: {again} first, or force it with check_parent=none")
    unlearned = not_learned(parent, stage) if check == "scores" else None
    if unlearned is not None:
        raise CheckpointError(
            f"{parent.path} {unlearned}: {again} longer, or force it with check_parent=stage"
        )


def not_learned(parent: Parent, stage: Stage) -> str | None:
    """Say why ``parent`` has not learned its task, None if it has."""
    if stage.parent_score is None:
        return None
    score = parent.scores.get(f"val/{stage.parent_score}")
    if score is None:
        return f"has never been validated, so that its {stage.parent_score} is unknown"
    if not score > stage.parent_minimum:
        return (
            f"has not learned {stage.parent_score.partition('/')[0]}: its validation {stage.parent_score} "
            f"is {score:.3g} and must exceed {stage.parent_minimum:g} (stage.parent_minimum)"
        )
    return None
