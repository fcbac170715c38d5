# SPDX-License-Identifier: Apache-2.0
"""What a preparation was asked for, and that a folder begun with it is continued with nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from raytran.data.files import SettingsRecord, exclusive_lock
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
    record = SettingsRecord(output / MARKER)
    is_new = not record.path.exists() and output.exists()
    if is_new and any(not entry.name.startswith(".") for entry in output.iterdir()):
        raise DataError(
            f"{output} holds other things than prepared data: choose a folder that does not exist yet"
        )
    different = record.begin({"format": FORMAT, **asdict(settings), **sources})
    if different:
        raise DataError(
            f"{record.path} says that the folder was begun with another {', '.join(different)}; "
            "choose another output folder or remove this one"
        )
    busy = DataError(f"another process prepares {output}: wait for it to end, or choose another folder")
    with exclusive_lock(record.path, if_taken=busy):
        yield
