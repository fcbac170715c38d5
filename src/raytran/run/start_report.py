# SPDX-License-Identifier: Apache-2.0
"""What a stage is about to do: what trains, what is frozen, which terms count, where it starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from raytran.model import RayTran
from raytran.training.stage import Stage


def start_report(stage: Stage, model: RayTran, parent: Mapping[str, Any] | None) -> list[str]:
    """Return the lines to log at the start of a fit.

    Args:
        stage: the stage; it is applied to ``model``, as the fit will do.
        model: the network.
        parent: the checkpoint that the first weights come from, as it is written into checkpoints.
    """
    stage.freeze(model)
    trained: dict[str, int] = {}
    frozen: dict[str, int] = {}
    for name, parameter in model.named_parameters():
        counts = trained if parameter.requires_grad else frozen
        part = _part(name)
        counts[part] = counts.get(part, 0) + parameter.numel()
    lines = [
        f"trains {_listed(trained)}",
        f"frozen {_listed(frozen)}",
        f"loss terms {', '.join(stage.terms)}; heads that run {', '.join(stage.tasks)}",
    ]
    if parent is not None:
        scores = parent["scores"]
        told = [
            f"{name} {value:.3g}" for name, value in scores.items() if name == f"val/{stage.parent_score}"
        ]
        at = f"stage {parent['stage']}, step {parent['step']}"
        lines.append(f"starts from {', '.join([at, *told])}: {parent['path']}")
    return lines


def _part(name: str) -> str:
    """Return ``backbone`` or ``heads.<name>`` for the name of a parameter."""
    words = name.split(".")
    return ".".join(words[:2]) if words[0] == "heads" else words[0]


def _listed(counts: Mapping[str, int]) -> str:
    """Return ``1,234 parameters: a 1,000, b 234``."""
    if not counts:
        return "nothing"
    parts = ", ".join(f"{name} {count:,}" for name, count in counts.items())
    return f"{sum(counts.values()):,} parameters: {parts}"
