# SPDX-License-Identifier: Apache-2.0
"""What every checkpoint says, whichever kind of file it is in."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from raytran.checkpoints.runs import STAGE_NAMES
from raytran.errors import CheckpointError

FORMAT = "raytran.checkpoint/1"

_REQUIRED = {"stage": str, "preset": str, "model": dict, "views": dict, "state_dict": dict}


class DamagedCheckpointError(CheckpointError):
    """A checkpoint that was whole once."""


def check_content(content: Any, path: Path) -> None:
    """Raise unless ``content`` is what this version of raytran writes.

    Raises:
        CheckpointError: it is of a newer version, of another program, or not all there.
    """
    found = content.get("format") if isinstance(content, dict) else None
    family, _, version = FORMAT.partition("/")
    if isinstance(found, str) and found.startswith(f"{family}/") and found != FORMAT:
        newer = found.removeprefix(f"{family}/")
        if newer.isdigit() and int(newer) > int(version):
            raise CheckpointError(
                f"{path} was written by a newer raytran (format {found}, this one reads {FORMAT}): "
                "update raytran"
            )
    if found != FORMAT:
        raise CheckpointError(f"{path} is no checkpoint of raytran: expected format {FORMAT}, got {found}")
    for name, kind in _REQUIRED.items():
        if not isinstance(content.get(name), kind):
            raise CheckpointError(f"{path} is no whole checkpoint of raytran: it has no proper '{name}'")
    if not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in content["state_dict"].items()
    ):
        raise CheckpointError(f"{path} is no checkpoint of raytran: some of its weights are no tensors")


def with_stage_names(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``content`` with its stages under the names they have now, see ``STAGE_NAMES``."""
    renamed = dict(content)
    renamed["stage"] = _stage_name(content["stage"])
    for name, keys in (("parent", ["stage"]), ("config", ["stage", "schedule"])):
        if isinstance(part := content.get(name), Mapping):
            renamed[name] = {key: _stage_name(value) if key in keys else value for key, value in part.items()}
    return renamed


def _stage_name(said: Any) -> Any:
    """Return what names stages with their present names: a name, a list of names, or settings by name."""
    if isinstance(said, str):
        return STAGE_NAMES.get(said, said)
    if isinstance(said, Mapping):
        return {
            STAGE_NAMES.get(key, key): _stage_name(value)
            if key in ("name", "parent", "other_parents")
            else value
            for key, value in said.items()
        }
    return [_stage_name(name) for name in said] if isinstance(said, list | tuple) else said
