# SPDX-License-Identifier: Apache-2.0
"""Weights to give away: those that the package carries, and how a checkpoint becomes such a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import raytran
from raytran.checkpoints.weights_file import PREFIX, SUFFIX, write_weights
from raytran.errors import CheckpointError, ConfigError

DEFAULT = "default"
"""Stands for the package's own weights wherever a checkpoint is named."""

FOLDER = Path(raytran.__file__).resolve().parent / "weights"
"""Where these are: one file, and the page that says what it can do."""

DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}

_KEPT = (
    *("format", "stage", "preset", "model", "views", "input_mask", "scores", "global_step", "warnings"),
    *("git_commit", "versions"),
)
"""Of what a checkpoint says. The rest is the state of training, and settings that hold a machine's paths."""


def checkpoint_path(checkpoint: str | Path) -> Path:
    """Return the file that a checkpoint's name stands for.

    Raises:
        CheckpointError: it is ``default``, and the package was built without weights.
    """
    if str(checkpoint) != DEFAULT:
        return Path(checkpoint)
    found = _files()
    if len(found) != 1:
        what = f"{len(found)} files of weights, not one," if found else "no weights"
        raise CheckpointError(
            f"there are {what} in {FOLDER}, which checkpoint=default stands for: give checkpoint=FILE, "
            "a .ckpt file that training wrote or a .safetensors file that was exported from one"
        )
    return found[0]


def shipped_weights() -> Path | None:
    """Return the package's own weights, None if it was built without."""
    found = _files()
    return found[0] if len(found) == 1 else None


def _files() -> list[Path]:
    return sorted(FOLDER.glob(f"*{SUFFIX}"))


def export_weights(checkpoint: Mapping[str, Any], source: Path, output: Path, *, dtype: str) -> None:
    """Write the network of a checkpoint to a safetensors file, without the state of training.

    Args:
        checkpoint: what ``read_checkpoint`` returned.
        source: where from, for messages.
        output: the file, which appears whole or not at all.
        dtype: one of ``DTYPES``, for the weights; counters stay integers.

    Raises:
        ConfigError: there is no such dtype.
        CheckpointError: some weights are beyond its range, or the file cannot be written.
    """
    if dtype not in DTYPES:
        raise ConfigError(f"unknown dtype={dtype}: choose one of {', '.join(DTYPES)}")
    weights = {
        name.removeprefix(PREFIX): _converted(value, DTYPES[dtype], f"{name} in {source}")
        for name, value in checkpoint["state_dict"].items()
        if name.startswith(PREFIX)
    }
    write_weights(output, _card(checkpoint), weights)


def _card(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the file says of itself."""
    card = {name: checkpoint[name] for name in _KEPT if name in checkpoint}
    parent = checkpoint.get("parent")
    if isinstance(parent, Mapping):
        card["parent"] = {name: parent.get(name) for name in ("stage", "step")}
    data = checkpoint.get("data")
    if isinstance(data, Mapping):
        card["data"] = {name: data.get(name) for name in ("name", "annotation")}
    return card | {"model": without_sources(checkpoint["model"])}


def without_sources(node: Any) -> Any:
    """Return a network's config without where first weights come from: a checkpoint's take their place."""
    if isinstance(node, Mapping):
        is_object = "_target_" in node
        return {
            name: None if is_object and name == "weights" else without_sources(value)
            for name, value in node.items()
        }
    return [without_sources(value) for value in node] if isinstance(node, list | tuple) else node


def _converted(value: Tensor, dtype: torch.dtype, name: str) -> Tensor:
    if not value.is_floating_point():
        return value
    if not value.isfinite().all():
        raise CheckpointError(f"{name} is not finite: export a checkpoint from before the training diverged")
    converted = value.to(dtype)
    if not converted.isfinite().all():
        raise CheckpointError(f"{name} is beyond the range of float16: choose dtype=bfloat16 or float32")
    return converted
