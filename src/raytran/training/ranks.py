# SPDX-License-Identifier: Apache-2.0
"""What the ranks of a parallel run compute together, so that they take the step that one rank would take."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
import torch.distributed as dist
from lightning.pytorch.plugins.layer_sync import TorchSyncBatchNorm
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

_INTEGER = {1: torch.uint8, 2: torch.int16, 4: torch.int32, 8: torch.int64}


def mean_over_ranks(values: Tensor) -> Tensor:
    """Return the mean of a tensor over the ranks; all of them must call this together.

    Unlike Lightning's ``reduce`` it waits for no other rank on the processor's side, only on the device's.
    """
    if not (dist.is_available() and dist.is_initialized()):
        return values
    total = values.clone()
    dist.all_reduce(total)
    return total / dist.get_world_size()


def agree(tensors: Iterable[Tensor], device: torch.device) -> bool:
    """Say whether tensors are the same on all ranks, bit by bit; all of them must call this together.

    Sums of the bits are compared, weighted by their place, so there is a rare chance that a change hides.
    """
    if not (dist.is_available() and dist.is_initialized()):
        return True
    sums = torch.zeros(2, dtype=torch.int64, device=device)
    for position, tensor in enumerate(tensors, start=1):
        bits = tensor.detach().reshape(-1).view(_INTEGER[tensor.element_size()]).long()
        place = torch.arange(len(bits), device=bits.device) % 8191
        sums += position * torch.stack([bits.sum(), (bits * place).sum()]).to(device)
    least, most = sums.clone(), sums.clone()
    dist.all_reduce(least, dist.ReduceOp.MIN)
    dist.all_reduce(most, dist.ReduceOp.MAX)
    return bool(torch.equal(least, most))


@torch.no_grad()
def average_statistics(model: nn.Module) -> None:
    """Give batch norms that each rank computes alone the statistics of all ranks' images together.

    All ranks must call this together. Means of means, and variances by the law of total variance. Statistics
    that are the same on all ranks stay what they are to the last bit, frozen ones among them.
    """
    norms = [norm for norm in model.modules() if isinstance(norm, _BatchNorm) and type(norm) in _OVER_RANKS]
    statistics = [
        (norm.running_mean, norm.running_var)
        for norm in norms
        if norm.running_mean is not None and norm.running_var is not None
    ]
    if not (statistics and dist.is_available() and dist.is_initialized()):
        return
    # float64 adds up equal numbers, and their squares, without rounding.
    mean = torch.cat([mean for mean, _ in statistics]).double()
    variance = torch.cat([variance for _, variance in statistics]).double()
    sums = torch.stack([mean, mean.square(), variance])
    dist.all_reduce(sums)
    mean, squares, variance = (sums / dist.get_world_size()).unbind()
    sizes = [len(own) for own, _ in statistics]
    both = mean.split(sizes), (variance + (squares - mean.square())).split(sizes)
    for own, *of_all in zip(statistics, *both, strict=True):
        for tensor, value in zip(own, of_all, strict=True):
            tensor.copy_(value)


class SyncedBatchNorm(TorchSyncBatchNorm):
    """Batch norm over the images, or voxels, of all ranks: on GPUs by PyTorch's own and on CPUs too.

    With statistics of each rank's own, ranks of one scene would normalise otherwise than one rank of several
    does, and end with running statistics that differ.

    Args:
        on_cpu: whether the ranks compute on CPUs.
    """

    def __init__(self, *, on_cpu: bool) -> None:
        self._on_cpu = on_cpu

    def apply(self, model: nn.Module) -> nn.Module:
        """Return the model with its batch norms exchanged."""
        if not self._on_cpu:
            return super().apply(model)
        return _exchange(model, _OVER_RANKS)

    def revert(self, model: nn.Module) -> nn.Module:
        """Return the model with usual batch norms."""
        return super().revert(_exchange(model, {ours: usual for usual, ours in _OVER_RANKS.items()}))


def _exchange(model: nn.Module, kinds: Mapping[type[nn.Module], type[nn.Module]]) -> nn.Module:
    """Give modules another class, one that has the same parameters and buffers and differs in ``forward``."""
    for module in model.modules():
        if type(module) in kinds:
            module.__class__ = kinds[type(module)]
    return model


class _NormOverRanks(_BatchNorm):
    """``SyncBatchNorm`` in plain operations, for the CPU, on which PyTorch's refuses to work."""

    def forward(self, input: Tensor) -> Tensor:
        """Normalise ``(n, C, ...)``."""
        if not self.training:
            return super().forward(input)
        exact = input.double()
        axes, count = (
            (0, *range(2, input.ndim)),
            exact.new_full(input.shape[1:2], input.numel() / input.shape[1]),
        )
        sums = torch.stack([exact.sum(axes), exact.square().sum(axes), count])
        total, squares, count = _SumOverRanks.apply(sums).unbind()
        mean = total / count
        variance = (squares / count - mean.square()).clamp(min=0)
        self._remember(mean.detach(), (variance * count / (count - 1)).detach())
        scale = self.weight * (variance + self.eps).rsqrt()
        mean, scale, bias = (x.view(-1, *(1,) * (input.ndim - 2)) for x in (mean, scale, self.bias))
        return ((exact - mean) * scale + bias).to(input.dtype)

    def _remember(self, mean: Tensor, variance: Tensor) -> None:
        if self.running_mean is None or self.running_var is None or self.num_batches_tracked is None:
            return
        self.num_batches_tracked.add_(1)
        momentum = 1.0 / float(self.num_batches_tracked) if self.momentum is None else self.momentum
        self.running_mean.lerp_(mean.to(self.running_mean.dtype), momentum)
        self.running_var.lerp_(variance.to(self.running_var.dtype), momentum)


class BatchNorm1dOverRanks(_NormOverRanks, nn.BatchNorm1d):
    """``nn.BatchNorm1d`` over all ranks."""


class BatchNorm2dOverRanks(_NormOverRanks, nn.BatchNorm2d):
    """``nn.BatchNorm2d`` over all ranks."""


class BatchNorm3dOverRanks(_NormOverRanks, nn.BatchNorm3d):
    """``nn.BatchNorm3d`` over all ranks."""


_OVER_RANKS: dict[type[nn.Module], type[nn.Module]] = {
    nn.BatchNorm1d: BatchNorm1dOverRanks,
    nn.BatchNorm2d: BatchNorm2dOverRanks,
    nn.BatchNorm3d: BatchNorm3dOverRanks,
}


class _SumOverRanks(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        total = values.clone()
        if dist.is_initialized():
            dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return _SumOverRanks.apply(gradient.contiguous())
