# SPDX-License-Identifier: Apache-2.0
"""What every checkpoint says, whichever kind of file it is in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from raytran.errors import CheckpointError

FORMAT = "raytran.checkpoint/2"
EARLIER_FORMAT = "raytran.checkpoint/1"

_REQUIRED = {"stage": str, "preset": str, "model": dict, "views": dict, "state_dict": dict}


class DamagedCheckpointError(CheckpointError):
    """A checkpoint that was whole once."""


def check_content(content: Any, path: Path) -> None:
    """Raise unless ``content`` is what this version of raytran reads.

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
    if found not in (FORMAT, EARLIER_FORMAT):
        raise CheckpointError(f"{path} is no checkpoint of raytran: expected format {FORMAT}, got {found}")
    for name, kind in _REQUIRED.items():
        if not isinstance(content.get(name), kind):
            raise CheckpointError(f"{path} is no whole checkpoint of raytran: it has no proper '{name}'")
    if not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in content["state_dict"].items()
    ):
        raise CheckpointError(f"{path} is no checkpoint of raytran: some of its weights are no tensors")
