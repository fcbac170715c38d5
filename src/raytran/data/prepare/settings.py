# SPDX-License-Identifier: Apache-2.0
"""What a preparation was asked for, and that a folder begun with it is continued with nothing else."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

from raytran.data.atomic import write_json
from raytran.errors import ConfigError, DataError

FORMAT = "raytran.prepared/1"
"""Rises when the same files no longer give the same folder."""

MARKER = "prepare.json"
"""The file that tells a prepared folder, begun or finished, and its settings."""


@dataclass(frozen=True)
class PrepareSettings:
    """What decides the bytes of a prepared scan.

    Attributes:
        image_size: ``(H, W)`` of the frames.
        max_frames: at most so many frames a scan, evenly spread; None for all.
        masks: whether the amodal masks of all frames are made ahead of training.
    """

    image_size: tuple[int, int] = (480, 640)
    max_frames: int | None = 200
    masks: bool = True

    def __post_init__(self) -> None:
        if min(self.image_size) < 16 or (self.max_frames is not None and self.max_frames < 2):
            raise ConfigError(
                "expected images of at least 16 × 16 pixels and max_frames ≥ 2, got "
                f"image_size={list(self.image_size)} and max_frames={self.max_frames}"
            )


@contextmanager
def claimed(output: Path, settings: PrepareSettings, sources: dict[str, Any]) -> Iterator[None]:
    """Hold ``output`` for the block, begun with the same settings or new.

    Args:
        output: the prepared folder; made if it is missing.
        settings: must be those it was begun with.
        sources: what tells the input, must be the same too.

    Raises:
        DataError: it was begun otherwise, holds other things, or another process works on it.
    """
    path = output / MARKER
    asked = json.loads(json.dumps({"format": FORMAT, **asdict(settings), **sources}))
    if not path.exists():
        if output.exists() and any(not found.name.startswith(".") for found in output.iterdir()):
            raise DataError(
                f"{output} holds other things than prepared data: choose a folder that does not exist yet"
            )
        write_json(path, asked)
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        found = {}
    if different := [key for key in asked if found.get(key) != asked[key]]:
        raise DataError(
            f"{path} says that the folder was begun with another {', '.join(different)}; "
            "choose another output folder or remove this one"
        )
    with path.open(encoding="utf-8") as file:
        _lock(file, output)
        yield


def _lock(file: TextIO, output: Path) -> None:
    """Lock ``file`` until it is closed; where that cannot be done it is for the user not to start two."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise DataError(
            f"another process prepares {output}: wait for it to end, or choose another folder"
        ) from error
    except (ImportError, OSError):
        # Windows, and some network disks.
        return
