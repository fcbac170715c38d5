# SPDX-License-Identifier: Apache-2.0
"""The counters of batch norms, advanced all together.

A batch norm counts the batches that it has seen: a launch of a kernel for each norm, and nothing of ours
reads the number.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn

_COUNTING = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d)
"""Norms that do without their counter; those that span ranks do not."""


@contextmanager
def batches_counted_together(model: nn.Module) -> Iterator[None]:
    """Count the batch that passes through ``model`` in this block once for all its batch norms."""
    norms: list[Any] = [
        module
        for module in model.modules()
        if type(module) in _COUNTING and module.training and module.momentum is not None
    ]
    counters = [norm.num_batches_tracked for norm in norms]
    try:
        for norm in norms:
            norm.num_batches_tracked = None
        yield
    finally:
        for norm, counter in zip(norms, counters, strict=True):
            norm.num_batches_tracked = counter
    found = [counter for counter in counters if counter is not None]
    if found:
        torch._foreach_add_(found, 1)
