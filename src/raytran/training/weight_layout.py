# SPDX-License-Identifier: Apache-2.0
"""How the weights of convolutions lie in the memory of a GPU: channels last, as the features do.

A convolution of features that lie so copies a weight that lies otherwise, forward and again backward, and
its gradient comes out channels last, to be copied once more. On a CPU weights stay as they are, and so do
results to the last bit.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn.modules.conv import _ConvNd
from torch.optim import Optimizer

_CHANNELS_LAST = {4: torch.channels_last, 5: torch.channels_last_3d}


def lay_channels_last(model: nn.Module) -> None:
    """Lay out the weights of all convolutions anew, in two or three dimensions; values stay what they are."""
    for module in model.modules():
        if isinstance(module, _ConvNd) and module.weight.ndim in _CHANNELS_LAST:
            form = _CHANNELS_LAST[module.weight.ndim]
            module.weight.data = module.weight.data.contiguous(memory_format=form)


def lay_moments_as_weights(optimizer: Optimizer) -> None:
    """Lay out an optimiser's moments as its weights, which lie otherwise where a checkpoint was written.

    A fused optimiser goes through both in the order of memory.
    """
    for weight, state in optimizer.state.items():
        for name, value in state.items():
            if value.shape == weight.shape and value.stride() != weight.stride():
                state[name] = torch.empty_like(weight, dtype=value.dtype).copy_(value)
