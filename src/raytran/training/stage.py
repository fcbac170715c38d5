# SPDX-License-Identifier: Apache-2.0
"""A stage of the curriculum (RayTran §4): which parts train, which heads run, which loss terms count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm

from raytran.errors import ConfigError
from raytran.model import RayTran


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One stage, one fit.

    Attributes:
        name: ``stage1``, ``stage2``, ``stage3``, ``novel_view``, …
        parent: name of the stage whose weights this one starts from, None for the first.
        other_parents: names of more stages that may be the parent, if one is given by hand.
        parent_experiment: the experiment that trains the parent, to be named in messages.
        parent_score: validation score by which the parent has learned its task, e.g. ``occupancy/iou``.
        parent_minimum: what that score must exceed for this stage to start.
        tasks: heads to run.
        terms: loss terms to minimise.
        targets: what the data set must provide.
        trainable: names of the model's parts that train, e.g. ``heads.shape``; all others are frozen and in
            evaluation mode, so that batch-norm statistics stay as they are.
        fresh_parts: names of the parts that start at random where the parent has none.
        restarted_parts: names of parts that start at random whatever the parent has, e.g. a head that is to
            have another form.
        new_views: frames of each scene that are held out to be rendered.
        freeze_norms: train with the batch-norm statistics that predictions use, and leave them as they are. A
            network that is trained on, with few scenes a step, then learns with what it predicts with.
    """

    name: str
    parent: str | None
    parent_experiment: str | None
    parent_score: str | None
    parent_minimum: float
    tasks: Sequence[str]
    terms: Sequence[str]
    targets: Sequence[str]
    trainable: Sequence[str]
    other_parents: Sequence[str] = ()
    fresh_parts: Sequence[str] = ()
    restarted_parts: Sequence[str] = ()
    new_views: int = 0
    freeze_norms: bool = False

    def freeze(self, model: RayTran) -> None:
        """Let gradients reach the parameters of ``model`` that train in this stage and no others.

        Parts that the stage's tasks never reach are frozen too: without a gradient DDP would wait for them.

        Raises:
            ConfigError: a name in ``trainable`` is not a part of the model, or one in ``restarted_parts`` is
                none that trains.
        """
        names = {name for name, _ in model.named_modules()}
        for part in self.trainable:
            if part not in names:
                raise ConfigError(f"{self.name} trains '{part}', which the model does not have")
        for part in self.restarted_parts:
            if part not in names or not is_within(part, self.trainable):
                raise ConfigError(
                    f"stage.restarted_parts names '{part}', which {self.name} does not train: "
                    f"choose from what it trains, {', '.join(self.trainable)}"
                )
        idle = self._idle(model)
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(is_within(name, self.trainable) and not is_within(name, idle))

    def training_modes(self, model: RayTran) -> list[tuple[nn.Module, bool]]:
        """Return every module of ``model`` and whether it is in training mode during this stage.

        Frozen parts are in evaluation mode, so that the statistics of their batch norms stay as they are, and
        so are all batch norms if ``freeze_norms``.
        """
        idle = self._idle(model)
        modes = []
        for name, module in model.named_modules():
            holds_trained = name == "" or any(part.startswith(f"{name}.") for part in self.trainable)
            trained = is_within(name, self.trainable) and not is_within(name, idle)
            keeps_statistics = self.freeze_norms and isinstance(module, _BatchNorm)
            modes.append((module, (trained or holds_trained) and not keeps_statistics))
        return modes

    def set_modes(self, model: RayTran) -> None:
        """Put every module of ``model`` in the mode of ``training_modes``."""
        for module, training in self.training_modes(model):
            module.training = training

    def _idle(self, model: RayTran) -> tuple[str, ...]:
        """Return the names of the parts of ``model`` that no gradient reaches in this stage."""
        return model.idle_modules({*self.tasks, *self.terms})


def is_within(name: str, parts: Sequence[str]) -> bool:
    """Say whether the module or parameter ``name`` is one of ``parts`` or inside one."""
    return any(name == part or name.startswith(f"{part}.") for part in parts)
