# SPDX-License-Identifier: Apache-2.0
"""A step kept for later study: a checkpoint that also holds the batches it took."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from raytran.checkpoints.file import read_checkpoint, write_checkpoint
from raytran.errors import CheckpointError
from raytran.structs import ObjectSet, SceneBatch, Views


def write_replay(
    path: Path,
    model: nn.Module,
    batches: Sequence[SceneBatch],
    *,
    card: Mapping[str, Any],
    step: int,
    precision: str,
    scale: float | None,
) -> None:
    """Write weights and batches of one step.

    Args:
        path: the file; one that is there is replaced.
        model: the network with the weights that the step began with.
        batches: what this rank was given in the step.
        card: what every checkpoint of the run carries.
        step: number of the step.
        precision: Lightning's name of it.
        scale: what the loss was multiplied by before the backward pass; None without a loss scaler.

    Raises:
        CheckpointError: the file cannot be written.
    """
    path.unlink(missing_ok=True)
    state = {f"model.{name}": value.cpu() for name, value in model.state_dict().items()}
    kept = {"precision": precision, "scale": scale, "batches": [_plain(batch.to("cpu")) for batch in batches]}
    write_checkpoint(path, {**card, "state_dict": state, "global_step": step, "replay": kept})


def read_replay(path: Path) -> tuple[dict[str, Any], list[SceneBatch]]:
    """Return the checkpoint that ``write_replay`` wrote, and its batches.

    Raises:
        CheckpointError: the file is missing, damaged, or holds no batches.
    """
    content = read_checkpoint(path)
    kept = content.get("replay")
    if not isinstance(kept, dict):
        raise CheckpointError(
            f"{path} is a checkpoint without batches: give the replay.pt that a run wrote when it stopped "
            "because its numbers were not finite"
        )
    try:
        float(kept.get("scale") or 1.0)
        return content, [_batch(plain) for plain in kept["batches"]]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"the batches in {path} are damaged: take another copy of the file") from error


def _plain(value: Any) -> Any:
    """Return structs as dictionaries, tuples as lists."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    # A copy: a view would take the whole storage it looks into along.
    return value.clone() if isinstance(value, Tensor) else value


def _batch(plain: Mapping[str, Any]) -> SceneBatch:
    objects = plain["objects"]
    return SceneBatch(
        **{
            **plain,
            "scene_id": tuple(plain["scene_id"]),
            "frame_id": tuple(tuple(names) for names in plain["frame_id"]),
            "views": Views(**plain["views"]),
            "new_views": None if plain.get("new_views") is None else Views(**plain["new_views"]),
            "objects": None
            if objects is None
            else tuple(ObjectSet(**{**one, "model_id": tuple(one["model_id"])}) for one in objects),
        }
    )
