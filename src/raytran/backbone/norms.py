# SPDX-License-Identifier: Apache-2.0
"""Batch norms in training with few scenes a step, where the views of one scene make a poor batch."""

from __future__ import annotations

from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm


def set_momentum(network: nn.Module, momentum: float) -> None:
    """Set the share of each batch in the running statistics of all batch norms of ``network``."""
    for module in network.modules():
        if isinstance(module, _BatchNorm):
            module.momentum = momentum
