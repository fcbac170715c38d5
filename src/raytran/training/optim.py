# SPDX-License-Identifier: Apache-2.0
"""The optimiser and its learning-rate schedule."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Literal

from torch import nn
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from raytran.setting_limits import check_settings
from raytran.training.weight_layout import lay_moments_as_weights


def learning_rate_factor(step: int, *, total_steps: int, warmup_steps: int, decay: str) -> float:
    """Return what the learning rate is multiplied with before step ``step`` (counted from 0).

    Rises linearly over ``warmup_steps``; then stays 1 (``decay="none"``) or falls to 0 at ``total_steps``
    along a half cosine (``decay="cosine"``).
    """
    if step < warmup_steps:
        return (step + 1) / warmup_steps
    if decay == "none":
        return 1.0
    progress = min(1.0, (step - warmup_steps) / max(1, total_steps - warmup_steps))
    return 0.5 * (1.0 + math.cos(math.pi * progress))


def _stay_as_fused(optimizer: Optimizer, state: dict[str, Any]) -> dict[str, Any]:
    """Return a saved state for this optimiser, also if it was fused where that ran and is not here."""
    fused = optimizer.defaults["fused"]
    return state | {"param_groups": [group | {"fused": fused} for group in state["param_groups"]]}


@dataclass(frozen=True, kw_only=True)
class Optimization:
    """AdamW with the paper's values (RayTran §4); the paper names no warm-up and no decay.

    Attributes:
        learning_rate: peak learning rate.
        weight_decay: decoupled weight decay, on all parameters.
        warmup_steps: optimiser steps of linear rise.
        decay: ``none`` or ``cosine``.

    Raises:
        ConfigError: a number is none that an optimiser can have.
    """

    learning_rate: float = 1e-4
    weight_decay: float = 5e-2
    warmup_steps: int = 0
    decay: Literal["none", "cosine"] = "none"

    def __post_init__(self) -> None:
        check_settings(asdict(self))

    def build(
        self, parameters: Iterable[nn.Parameter], total_steps: int, *, fused: bool = False
    ) -> dict[str, Any]:
        """Return optimiser and schedule for the parameters that train, as Lightning expects them.

        Args:
            parameters: of the network.
            total_steps: of the schedule.
            fused: all in few kernels, which also clip (``grad_scale``) and skip a step (``found_inf``).
        """
        trained = [parameter for parameter in parameters if parameter.requires_grad]
        optimizer = AdamW(trained, lr=self.learning_rate, weight_decay=self.weight_decay, fused=fused)
        optimizer.register_load_state_dict_pre_hook(_stay_as_fused)
        optimizer.register_load_state_dict_post_hook(lay_moments_as_weights)
        factor = partial(
            learning_rate_factor, total_steps=total_steps, warmup_steps=self.warmup_steps, decay=self.decay
        )
        return {
            "optimizer": optimizer,
            "lr_scheduler": {
                "scheduler": LambdaLR(optimizer, factor),
                "interval": "step",
                "name": "schedule/learning_rate",  # by which Lightning's LearningRateMonitor logs it
            },
        }
