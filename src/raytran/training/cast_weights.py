# SPDX-License-Identifier: Apache-2.0
"""Weights in 16 bits for a step of training, cast all together.

Autocast casts every weight where it is used, and its gradient back: two launches each, of kernels of a
microsecond. A copy of all weights of a part takes a launch for dozens of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import groupby
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.conv import _ConvNd

from raytran.ops.norms import LayerNorm

_CAST = (nn.Linear, _ConvNd, nn.MultiheadAttention, LayerNorm)
"""Modules that autocast runs in 16 bits, and norms that follow their input."""


@contextmanager
def weights_cast_together(model: nn.Module, device_type: str) -> Iterator[None]:
    """Let the modules of ``model`` find 16-bit weights in this block, if autocast is on; else do nothing.

    The gradients of each part, ``backbone.blocks`` or ``heads.objects``, come to the weights together.
    """
    if not torch.is_autocast_enabled(device_type):
        yield
        return
    dtype = torch.get_autocast_dtype(device_type)
    places = [
        (path, module, name)
        for path, module in model.named_modules()
        if isinstance(module, _CAST)
        for name, weight in module.named_parameters(recurse=False)
        if weight.dtype == torch.float32
    ]
    weights = [module._parameters[name] for _, module, name in places]
    try:
        for _, members in groupby(places, key=lambda place: place[0].split(".")[:2]):
            part = [(module, name) for _, module, name in members]
            cast = _CastTogether.apply(dtype, *(module._parameters[name] for module, name in part))
            for (module, name), in_16_bits in zip(part, cast, strict=True):
                module._parameters[name] = in_16_bits
        yield
    finally:
        for (_, module, name), weight in zip(places, weights, strict=True):
            module._parameters[name] = weight


class _CastTogether(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dtype: torch.dtype, *weights: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        return _cast(weights, dtype)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        exact = iter(_cast([gradient for gradient in gradients if gradient is not None], torch.float32))
        return None, *(None if gradient is None else next(exact) for gradient in gradients)


def _cast(tensors: Any, dtype: torch.dtype) -> tuple[Tensor, ...]:
    copies = tuple(torch.empty_like(tensor, dtype=dtype) for tensor in tensors)
    if copies:
        torch._foreach_copy_(copies, tensors)
    return copies
