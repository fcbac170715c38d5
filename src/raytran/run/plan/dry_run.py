# SPDX-License-Identifier: Apache-2.0
"""The memory of a step or a prediction, from running it on tensors without data.

The network's own code runs on torch's fake tensors, which have sizes and a life but no data, while a tally of
the living ones is kept: so whatever the code keeps for its backward pass, frees, chunks or computes again is
in the figure. Only what depends on the values of a tensor, the pairs and what runs along them, is replaced by
stand-ins that allocate what the real thing does. Scratch memory inside one operation of torch is not seen.
"""

from __future__ import annotations

import copy
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.autograd.function import once_differentiable
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import raytran.backbone.block
import raytran.backbone.chunked
import raytran.backbone.image_features
import raytran.extensions.unprojection
import raytran.ops.tracer
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.model import RayTran
from raytran.ops.pairs import PairList


class LiveMemory(TorchDispatchMode):
    """Keeps the tally of the bytes of all tensors alive that came up while it was on."""

    def __init__(self) -> None:
        super().__init__()
        self.live = 0
        self.peak = 0
        self._known: set[int] = set()

    def track(self, tensors: Any) -> None:
        """Count tensors (or whatever holds some) until they are freed; each storage once."""
        for tensor in tree_leaves(tensors):
            if isinstance(tensor, Tensor):
                storage = tensor.untyped_storage()
                if id(storage) not in self._known:
                    self._known.add(id(storage))
                    self.live += storage.nbytes()
                    weakref.finalize(storage, self._freed, id(storage), storage.nbytes())
        self.peak = max(self.peak, self.live)

    def _freed(self, key: int, size: int) -> None:
        self._known.discard(key)
        self.live -= size

    def __torch_dispatch__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        out = function(*args, **(kwargs or {}))
        self.track(out)
        return out


def fake_copy(model: RayTran) -> RayTran:
    """Return the model with weights that have no data; to be called in a ``FakeTensorMode``."""
    blank = copy.copy(model)
    for part in _copy_tree(blank).modules():
        for name, weight in part._parameters.items():
            if weight is not None:
                empty = torch.empty(weight.shape, dtype=weight.dtype)
                part._parameters[name] = nn.Parameter(empty, weight.requires_grad)
        for name, buffer in part._buffers.items():
            if buffer is not None:
                part._buffers[name] = torch.empty(buffer.shape, dtype=buffer.dtype)
    return blank


def _copy_tree(module: nn.Module) -> nn.Module:
    """Give a shallow copy its own dictionaries of parts, parameters and buffers, all the way down."""
    module._parameters, module._buffers = dict(module._parameters), dict(module._buffers)
    module._modules = {
        name: None if part is None else _copy_tree(copy.copy(part)) for name, part in module._modules.items()
    }
    return module


@contextmanager
def stand_ins(pairs_per_pixel: float, *, fused: bool) -> Iterator[None]:
    """Let the network run on fake tensors: pairs by number, attention and splat by what they allocate.

    Args:
        pairs_per_pixel: P over the cells of all feature maps.
        fused: attention keeps a number per target and head; False: a weight per pair and head.
    """

    def trace_pairs(
        cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int = 2
    ) -> PairList:
        scenes, views = cameras.intrinsics.shape[:2]
        pixels = scenes * views * feature_size[0] * feature_size[1]
        index = torch.empty(2, round(pairs_per_pixel * pixels), dtype=torch.int64)
        return PairList(index[0], index[1], pixels, scenes * grid.num_voxels)

    def pair_centers(cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int]) -> PairList:
        return trace_pairs(cameras, grid, feature_size)

    def ray_attention(query: Tensor, key: Tensor, value: Tensor, pairs: PairList, *_: Any, **__: Any) -> Any:
        kept = query.shape[0] if fused else len(pairs)
        return _Attention.apply(query, key, value, kept, fused)

    def splat_features(features: Tensor, pairs: PairList) -> tuple[Tensor, Tensor]:
        return _Splat.apply(features, pairs.num_voxels), torch.empty(pairs.num_voxels, dtype=torch.bool)

    def ray_attention_with_sum(*arguments: Any) -> tuple[Tensor, Tensor]:
        out = ray_attention(*arguments)
        return out, torch.empty(out.shape[:2], dtype=torch.float32)

    replaced = {
        raytran.ops.tracer: (trace_pairs,),
        raytran.extensions.unprojection: (pair_centers,),
        raytran.backbone.block: (ray_attention,),
        raytran.backbone.image_features: (splat_features,),
        raytran.backbone.chunked: (ray_attention, splat_features, ray_attention_with_sum),
    }
    real = [(module, f.__name__, getattr(module, f.__name__)) for module, fs in replaced.items() for f in fs]
    try:
        for module, functions in replaced.items():
            for function in functions:
                setattr(module, function.__name__, function)
        yield
    finally:
        for module, name, function in real:
            setattr(module, name, function)


class _Attention(torch.autograd.Function):
    """Allocates what ``ray_attention`` does."""

    @staticmethod
    def forward(ctx: Any, query: Tensor, key: Tensor, value: Tensor, kept: int, fused: bool) -> Tensor:
        out = torch.empty_like(query)
        # The sparse path computes in float32, the fused kernels in the dtype that comes in.
        used = (query, key, value) if fused else (query.float(), key.float(), value.float())
        ctx.save_for_backward(*used, torch.empty(query.shape[1], kept), *((out,) if fused else ()))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        query, key, value = ctx.saved_tensors[:3]
        return *(torch.empty_like(x).to(grad.dtype) for x in (query, key, value)), None, None


class _Splat(torch.autograd.Function):
    """Allocates what ``splat_features`` does."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, num_voxels: int) -> Tensor:
        ctx.like = features.shape, features.dtype
        return features.float().new_empty(num_voxels, features.shape[1]).to(features.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return grad.new_empty(ctx.like[0], dtype=torch.float32).to(ctx.like[1]), None


def peak_bytes(run: Callable[[LiveMemory], None]) -> int:
    """Return the most bytes alive at once while ``run`` works on fake tensors.

    Args:
        run: makes its tensors itself; gets the tally, to which it may enter some.
    """
    memory = LiveMemory()
    with FakeTensorMode(), memory:
        run(memory)
    return memory.peak
