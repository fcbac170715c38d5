# SPDX-License-Identifier: Apache-2.0
"""A stage of the curriculum (RayTran §4): which parts train, which heads run, which loss terms count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import nn

from raytran.errors import ConfigError
from raytran.model import RayTran


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One stage, one fit.

    Attributes:
        name: ``occupancy``, ``joint``, ``shape``, …
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
        begins: names of the parts that start at random where the parent has none.
        new_views: frames of each scene that are held out to be rendered.
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
    begins: Sequence[str] = ()
    new_views: int = 0

    def freeze(self, model: RayTran) -> None:
        """Let gradients reach the parameters of ``model`` that train in this stage and no others.

        Parts that the stage's tasks never reach are frozen too: without a gradient DDP would wait for them.

        Raises:
            ConfigError: a name in ``trainable`` is not a part of the model.
        """
        names = {name for name, _ in model.named_modules()}
        for part in self.trainable:
            if part not in names:
                raise ConfigError(f"stage {self.name} trains '{part}', which the model does not have")
        idle = model.idle_modules({*self.tasks, *self.terms})
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(_is_within(name, self.trainable) and not _is_within(name, idle))

    def set_mode(self, model: nn.Module) -> None:
        """Put every part of ``model`` that is frozen in evaluation mode; leave the others as they are."""
        for name, module in model.named_modules():
            holds_trainable = name == "" or any(part.startswith(f"{name}.") for part in self.trainable)
            if not holds_trainable and not _is_within(name, self.trainable):
                module.training = False


def _is_within(name: str, parts: Sequence[str]) -> bool:
    """Say whether the module or parameter ``name`` is one of ``parts`` or inside one."""
    return any(name == part or name.startswith(f"{part}.") for part in parts)
