# SPDX-License-Identifier: Apache-2.0
"""How Lightning's Trainer reads and writes checkpoint files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.pytorch.plugins.io import TorchCheckpointIO

from raytran.training.checkpoint_file import read_checkpoint, write_checkpoint


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes beside the target and renames; reads with ``weights_only=True`` and errors in one sentence."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write ``checkpoint`` to ``path`` atomically."""
        write_checkpoint(Path(path), checkpoint)

    def load_checkpoint(self, path: Any, *_: Any, **__: Any) -> dict[str, Any]:
        """Read ``path``.

        Raises:
            CheckpointError: the file is missing or damaged.
        """
        return read_checkpoint(Path(path))
