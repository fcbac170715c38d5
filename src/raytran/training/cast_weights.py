# SPDX-License-Identifier: Apache-2.0
"""Weights in 16 bits for a step of training, cast all together.

Autocast casts every weight where it is used, and its gradient back: two launches each, of kernels of a
microsecond. A copy of all weights of a part takes a launch for dozens of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.conv import _ConvNd

from raytran.norms import GroupNorm, LayerNorm

_CAST = (nn.Linear, _ConvNd, nn.MultiheadAttention, LayerNorm, GroupNorm)
"""Modules that autocast runs in 16 bits, and norms that follow their input."""

_OURS = ("raytran.model", "raytran.backbone.", "raytran.heads.", "raytran.norms")
"""Where modules leave it to autocast in which precision their parts compute; others may not."""


@contextmanager
def weights_cast_together(model: nn.Module, device_type: str) -> Iterator[None]:
    """Let the modules of ``model`` find weights in autocast's 16 bits in this block.

    The gradients of each part, encoder, backbone or heads, come to their weights together: between ranks they
    travel while those of the parts before are computed.
    """
    dtype = torch.get_autocast_dtype(device_type)
    # Frozen weights apart: of what is cast with one that learns, gradients are computed.
    parts: dict[tuple[str, bool], list[tuple[nn.Module, str, nn.Parameter]]] = {}
    for path, module in _under_autocast(model, ""):
        for name, weight in module.named_parameters(recurse=False):
            part = "encoder" if ".encoder." in path else path.split(".")[0]
            parts.setdefault((part, weight.requires_grad), []).append((module, name, weight))
    try:
        for members in parts.values():
            cast = _CastTogether.apply(dtype, *(weight for *_, weight in members))
            for (module, name, _), in_16_bits in zip(members, cast, strict=True):
                module._parameters[name] = in_16_bits
        yield
    finally:
        for members in parts.values():
            for module, name, weight in members:
                module._parameters[name] = weight


def _under_autocast(owner: nn.Module, path: str) -> Iterator[tuple[str, nn.Module]]:
    """Yield path and module of all that are cast."""
    for name, module in owner.named_children():
        kind = type(module).__module__
        if kind.startswith((*_OURS, "torch.nn.")):
            if isinstance(module, _CAST):
                yield path + name, module
            yield from _under_autocast(module, f"{path}{name}.")


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
