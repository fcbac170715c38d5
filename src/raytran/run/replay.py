# SPDX-License-Identifier: Apache-2.0
"""One step of a run that gave up, done again under watch: where do its numbers stop being finite?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from torch import Tensor, nn

from raytran.checkpoints.checkpoint import model_from
from raytran.checkpoints.network import trusted_packages
from raytran.errors import CheckpointError, ConfigError
from raytran.losses.matcher import HungarianMatcher
from raytran.losses.total import TotalLoss
from raytran.model import RayTran, inputs_of
from raytran.run.device import choose_device, set_matmul_precision
from raytran.structs import SceneBatch, TensorStruct
from raytran.training.replay_file import read_replay
from raytran.training.stage import Stage

PRECISIONS = {"32-true": None, "bf16-mixed": torch.bfloat16, "16-mixed": torch.float16}


@dataclass
class Replayed:
    """What a step did.

    Attributes:
        parts: modules whose output was not finite, in the order in which they ran, innermost first.
        losses: value of each term, mean over the batches.
        gradients: parameters whose gradient was not finite.
    """

    parts: list[str] = field(default_factory=list)
    losses: dict[str, float] = field(default_factory=dict)
    gradients: list[str] = field(default_factory=list)


def replay(cfg: DictConfig) -> Replayed:
    """Run ``python -m raytran.replay``: do the step, say what was found.

    Raises:
        CheckpointError: the file is missing, damaged, or no replay.
        ConfigError: a setting has a value that does not exist.
    """
    path = Path(cfg.file)
    content, batches = read_replay(path)
    precision = cfg.precision or content["replay"].get("precision")
    if precision not in PRECISIONS:
        raise ConfigError(f"unknown precision={precision}: choose one of {', '.join(PRECISIONS)}")
    device = choose_device(cfg.device)
    model, loss, stage = _parts(content, path, trusted_packages(cfg.trust))
    set_matmul_precision(content["config"].get("matmul_precision", "auto"), device)
    scale = content["replay"].get("scale") if precision == "16-mixed" else None
    stage.freeze(model.to(device))
    stage.set_modes(model)
    found = run_step(
        model,
        loss,
        stage,
        [batch.to(device) for batch in batches],
        autocast=PRECISIONS[precision],
        scale=scale or 1.0,
    )
    scenes = ", ".join(scene for batch in batches for scene in batch.scene_id)
    step = content.get("global_step")
    scaled = "" if scale is None else f", loss times {scale:g}"
    _show(found, f"step {step} of {stage.name}, scenes {scenes}, {precision} on {device.type}{scaled}")
    return found


def run_step(
    model: RayTran,
    loss: TotalLoss,
    stage: Stage,
    batches: list[SceneBatch],
    *,
    autocast: torch.dtype | None,
    scale: float = 1.0,
) -> Replayed:
    """Return what a step does, forward and backward, without changing a weight.

    Args:
        model: the network, frozen and in the modes of the stage.
        loss: its loss.
        stage: what it is trained to do.
        batches: of the step.
        autocast: type of the forward pass under autocast, None for float32 throughout.
        scale: what the loss is multiplied by before the backward pass. In float16 gradients overflow by the
            scale that keeps the small ones from vanishing, long before they would without.
    """
    found = Replayed()
    with _watched(model, found.parts):
        for batch in batches:
            device = batch.grid_center.device.type
            with torch.autocast(device, dtype=autocast, enabled=autocast is not None):
                raw = model(**inputs_of(batch), tasks=stage.tasks)
                losses = loss(raw, batch, terms=stage.terms, decode_shapes=model.decode_shapes)
            (scale * losses["total"] / len(batches)).backward()
            for name, value in losses.items():
                found.losses[name] = found.losses.get(name, 0.0) + float(value.detach()) / len(batches)
    found.gradients += [
        name for name, p in model.named_parameters() if p.grad is not None and not p.grad.isfinite().all()
    ]
    return found


@contextmanager
def _watched(model: nn.Module, parts: list[str]) -> Iterator[None]:
    """Add the name of each module whose output is not finite to ``parts`` while the block runs."""

    def watch(name: str) -> Any:
        def hook(module: nn.Module, arguments: Any, output: Any) -> None:
            if name not in parts and not _is_finite(output):
                parts.append(name)

        return hook

    handles = [module.register_forward_hook(watch(name)) for name, module in model.named_modules() if name]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def _is_finite(value: Any) -> bool:
    if isinstance(value, Tensor):
        return not value.is_floating_point() or bool(value.isfinite().all())
    if isinstance(value, TensorStruct):
        return all(_is_finite(item) for item in vars(value).values())
    return all(map(_is_finite, value)) if isinstance(value, tuple | list) else True


def _parts(
    content: Mapping[str, Any], path: Path, trust: tuple[str, ...]
) -> tuple[RayTran, TotalLoss, Stage]:
    """Return network, loss and stage; the file may come from anybody, so only trusted classes are run."""
    model = model_from(content, path, trust=trust)
    try:
        loss, stage = content["config"]["loss"], dict(content["config"]["stage"])
        if stage.pop("_target_") != "raytran.training.stage.Stage":
            raise KeyError("stage")
        if loss["_target_"] != "raytran.losses.total.TotalLoss":
            raise KeyError("loss")
        matcher = HungarianMatcher(**_without_target(loss["matcher"]))
        total = TotalLoss(**_without_target(loss) | {"matcher": matcher})
        return model, total, Stage(**stage)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(
            f"{path} was written with a stage or a loss of another kind than raytran's: replay it in Python "
            "with raytran.run.replay.run_step"
        ) from error


def _without_target(node: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in node.items() if name != "_target_"}


def _show(found: Replayed, title: str) -> None:
    console = Console(soft_wrap=True, highlight=False, markup=False)
    console.print(title)
    console.print("losses: " + ", ".join(f"{name} {value:.4g}" for name, value in found.losses.items()))
    if found.parts:
        console.print("not finite in the forward pass, in order: " + ", ".join(found.parts[:12]))
    if found.gradients:
        more = f" and {len(found.gradients) - 12} more" if len(found.gradients) > 12 else ""
        console.print("not finite in the gradients: " + ", ".join(found.gradients[:12]) + more)
    if not found.parts and not found.gradients:
        console.print("everything is finite here: the trouble is of the run's precision or of its device")
