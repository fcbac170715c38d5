# SPDX-License-Identifier: Apache-2.0
"""How Lightning's Trainer reads and writes checkpoint files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.pytorch.plugins.io import TorchCheckpointIO

from raytran.checkpoints.file import read_checkpoint, write_checkpoint
from raytran.errors import CheckpointError


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes beside the target and renames; reads with ``weights_only=True`` and errors in one sentence.

    Attributes:
        error: why the last writing failed, None if it did not. Only the first rank writes, and all wait for
            it afterwards: an exception there would leave the others waiting.
    """

    def __init__(self) -> None:
        super().__init__()
        self.error: CheckpointError | None = None

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write ``checkpoint`` to ``path`` atomically; a failure is kept in ``error``."""
        try:
            write_checkpoint(Path(path), checkpoint)
        except CheckpointError as error:
            self.error = error
        else:
            self.error = None

    def load_checkpoint(self, path: Any, *_: Any, **__: Any) -> dict[str, Any]:
        """Read ``path``.

        Raises:
            CheckpointError: the file is missing or damaged.
        """
        return read_checkpoint(Path(path))
