# SPDX-License-Identifier: Apache-2.0
"""Names the settings to change when memory runs out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from omegaconf import DictConfig, OmegaConf

from raytran.errors import ConfigError

_SAVING = {
    "views.batch_size": "fewer",
    "views.num_views": "fewer",
    "trainer.precision": "bf16-mixed",
    "model.backbone.checkpoint_blocks": "true",
    "views.image_size": "smaller",
}
"""What each setting may become (docs/out-of-memory.md); those that change the result least come first."""


TOO_SMALL = "does not suffice for a step"
"""In what is said then, and in nothing else."""


@contextmanager
def explained_out_of_memory(cfg: DictConfig) -> Iterator[None]:
    """Turn an out-of-memory error inside the block into one that names the settings to change.

    Raises:
        ConfigError: memory did not suffice, on the GPU or beside it.
    """
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        where = _place(error)
        if where is None:
            raise
        # The traceback's frames hold the tensors of the failed step: free them first.
        error.__traceback__ = None
        raise ConfigError(f"{where} {TOO_SMALL}: change {_advice(cfg)}") from None


def _place(error: BaseException) -> str | None:
    """Return which memory was too small, None if the error is another one."""
    if isinstance(error, torch.OutOfMemoryError):
        return "the memory of the GPU"
    if isinstance(error, MemoryError) or "DefaultCPUAllocator" in str(error):
        return "the memory of the machine"
    return None


def _advice(cfg: DictConfig) -> str:
    """Name the settings that can still save memory."""
    found = []
    for name, effect in _SAVING.items():
        now = OmegaConf.select(cfg, name)
        spent = (
            now in (None, True)
            or (name == "views.batch_size" and now == 1)
            or (name == "trainer.precision" and "16" in str(now))
        )
        if not spent:
            value = list(now) if OmegaConf.is_list(now) else str(now).lower()
            found.append(f"{name} (now {value}: {effect})")
    return ", or ".join(found)
