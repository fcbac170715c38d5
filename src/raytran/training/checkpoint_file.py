# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files: tensors and plain Python only, never half-written under their final name."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import torch

from raytran.errors import CheckpointError

FORMAT = "raytran.checkpoint/1"


def write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` to ``path``; a kill at any moment leaves the old file or the new one, whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.part")
    with partial.open("wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return the content of a checkpoint, on the CPU.

    Raises:
        CheckpointError: the file is missing, damaged, or no checkpoint of raytran.
    """
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}: give the path of a .ckpt file that training wrote")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, pickle.UnpicklingError) as error:
        raise CheckpointError(
            f"cannot read {path}: the file is damaged or cut short; take another copy of it, "
            "or delete it and train that stage again"
        ) from error
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise CheckpointError(f"{path} is no checkpoint of raytran: expected format {FORMAT}, got {found}")
    return content
