# SPDX-License-Identifier: Apache-2.0
"""Which settings to change when the memory does not suffice."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from omegaconf import DictConfig, OmegaConf

from raytran.errors import ConfigError

_SAVING = {
    "views.batch_size": "fewer scenes at once; trainer.accumulate_grad_batches makes up for it",
    "views.num_views": "fewer frames a scene",
    "trainer.precision": "bf16-mixed halves what is kept for the backward pass",
    "model.backbone.checkpoint_blocks": "true computes the blocks twice instead of keeping them",
    "views.image_size": "smaller images",
}
"""Setting → what changing it does, dearest to the result last."""


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
        # The frames of the failed step hold its tensors: let them go before anything else is done.
        error.__traceback__ = None
        raise ConfigError(f"{where} does not suffice for a step: change {_advice(cfg)}") from None


def _place(error: BaseException) -> str | None:
    """Return which memory was too small, None if that was not the trouble."""
    if isinstance(error, torch.OutOfMemoryError):
        return "the memory of the GPU"
    if isinstance(error, MemoryError) or "DefaultCPUAllocator" in str(error):
        return "the memory of the machine"
    return None


def _advice(cfg: DictConfig) -> str:
    """Name the settings that still have something to give."""
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
