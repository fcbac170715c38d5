# SPDX-License-Identifier: Apache-2.0
"""Memory and work of a training step or a prediction, from running it on tensors without data.

The network's own code runs on torch's fake tensors, which have sizes and a device but no data, while a tally
is kept of those alive: whatever the code keeps for its backward pass, frees, takes in chunks or computes
again is in the figure. Pairs alone depend on data; they are replaced by as many without data. Attention and
splat are operators of torch that know their sizes; two of them have stand-ins (``StandIns``). Scratch memory
inside an operator is not seen. torch's own tracker, ``torch.distributed._tools.MemTracker``, would do but for
frozen weights, on which it fails.
"""

from __future__ import annotations

import copy
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.autograd.function import once_differentiable
from torch.autograd.graph import _engine_run_backward
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.model import SHAPES_AT_ONCE, RayTran
from raytran.ops.pairs import PairList, PairOrder, Side
from raytran.run.plan.roofline import Ceilings, Work, work_of_adamw, work_of_attention, work_of_operation
from raytran.structs import RawScene, Views
from raytran.training.stage import Stage

MATCHED_OBJECTS = 30
"""Objects of a scene whose shapes are decoded in training; ScanNet's rooms have 14 on average."""

_AUTOCAST = {"16-mixed": torch.float16, "bf16-mixed": torch.bfloat16, "32-true": None}
PRECISIONS = tuple(_AUTOCAST)


@dataclass(frozen=True)
class Load:
    """The size of a step.

    Attributes:
        scenes: B.
        views: N of each scene.
        image_size: ``(H, W)``.
        pairs_per_pixel: P over the cells of all feature maps.
        fused: attention runs in fused kernels, as on a GPU.
    """

    scenes: int
    views: int
    image_size: tuple[int, int]
    pairs_per_pixel: float
    fused: bool

    def fake_views(self, channels: int) -> Views:
        """Return views without data; to be called in a ``FakeTensorMode``."""
        lead = (self.scenes, self.views)
        images = torch.empty(*lead, channels, *self.image_size, dtype=torch.uint8)
        return Views(images, torch.empty(*lead, 3, 3), torch.empty(*lead, 4, 4))


class FakePairs(PairList):
    """Pairs without data: as many as there would be."""

    @classmethod
    def of(cls, num_pixels: int, num_voxels: int, pairs_per_pixel: float) -> FakePairs:
        """Return pairs; to be called in a ``FakeTensorMode``."""
        index = torch.empty(2, round(pairs_per_pixel * num_pixels), dtype=torch.int64)
        return cls(index[0], index[1], num_pixels, num_voxels)

    def by(self, rows: Side) -> PairOrder:
        """Return one of the two orders."""
        count = self.num_pixels if rows == "pixels" else self.num_voxels
        offsets = torch.empty(count + 1, dtype=torch.int32)
        return PairOrder(offsets, torch.empty_like(self.pixel_index, dtype=torch.int32), self.pixel_index)


class Tally(TorchDispatchMode):
    """Counts the bytes of all tensors alive that came up while it was on, and the work that was done.

    Attributes:
        live: bytes alive.
        peak: the most there were.
        work: of each operation.
    """

    def __init__(self) -> None:
        super().__init__()
        self.live = 0
        self.peak = 0
        self.work: list[Work] = []
        self._storages: set[int] = set()

    def seconds(self, ceilings: Ceilings) -> float:
        """Return the least time that the work takes."""
        return sum(work.seconds(ceilings) for work in self.work)

    def __torch_dispatch__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        out = function(*args, **(kwargs or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, Tensor):
                self._follow(tensor.untyped_storage())
        self.peak = max(self.peak, self.live)
        self.work.append(_work(function, args, kwargs or {}, out))
        return out

    def _follow(self, storage: torch.UntypedStorage) -> None:
        """Count a storage from now until it is freed, however many tensors look into it."""
        key, size = id(storage), storage.nbytes()
        if key not in self._storages:
            self._storages.add(key)
            self.live += size
            weakref.finalize(storage, self._freed, key, size)

    def _freed(self, key: int, size: int) -> None:
        self._storages.discard(key)
        self.live -= size


def _work(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any], out: Any) -> Work:
    """Return the work of an operation, of attention over a pair list by the number of its pairs."""
    name = function.name()
    if not name.startswith("raytran::pair_attention"):
        return work_of_operation(function, args, kwargs, out)
    backward = name.startswith("raytran::pair_attention_backward")
    (query, key), (_, column, _) = (args[1][:2], args[2]) if backward else (args[:2], args[3])
    targets, heads, width = query.shape
    rows = targets + key.shape[0]
    return work_of_attention(len(column), rows, heads * width, query.element_size(), backward=backward)


class StandIns(TorchFunctionMode):
    """Replaces operators of raytran that do not run as they are without data.

    The splat's backward pass multiplies sparse matrices, which torch cannot do without data. Attention on a
    GPU keeps less than over a pair list; its kernels may not be installed where one plans.

    Args:
        tally: gets the work of attention on a GPU.
        load: the size of the step.
        num_voxels: of all scenes.
        dtype: of the features.
    """

    def __init__(self, tally: Tally, load: Load, num_voxels: int, dtype: torch.dtype) -> None:
        super().__init__()
        self._tally, self._load, self._num_voxels, self._dtype = tally, load, num_voxels, dtype

    def __torch_function__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if function is torch.ops.raytran.pair_mean.default:
            return _Splat.apply(args[0], args[1][0].shape[0] - 1, self)
        if function is torch.ops.raytran.pair_attention.default and self._load.fused:
            return _FusedAttention.apply(*args[:3], self)
        return function(*args, **(kwargs or {}))

    def add_splat(self, num_pixels: int, num_voxels: int, channels: int) -> None:
        """Enter the work of one pass of the splat: an addition a pair and channel, each row moved once."""
        moved = (num_pixels + num_voxels) * channels * self._dtype.itemsize
        self._tally.work.append(Work(self._load.pairs_per_pixel * num_pixels * channels, moved))

    def add_attention(self, query: Tensor, key: Tensor, *, backward: bool) -> None:
        """Enter the work of one pass of attention."""
        rows = len(query) + len(key)
        pairs = self._load.pairs_per_pixel * (rows - self._num_voxels)
        channels, size = query.shape[1] * query.shape[2], self._dtype.itemsize
        self._tally.work.append(work_of_attention(pairs, rows, channels, size, backward=backward))

    def kept(self, tensor: Tensor) -> Tensor:
        """Return what the kernels keep of a tensor: they take it in the dtype of the features."""
        return tensor.to(self._dtype)


class _FusedAttention(torch.autograd.Function):
    """Returns what ``raytran::pair_attention`` does, and keeps a number a target and head."""

    @staticmethod
    def forward(ctx: Any, query: Tensor, key: Tensor, value: Tensor, mode: StandIns) -> tuple[Tensor, ...]:
        mode.add_attention(query, key, backward=False)
        ctx.mode = mode
        logsumexp, nothing, sums = (query.new_empty(query.shape[:2]), query.new_empty(0), query.new_empty(0))
        ctx.save_for_backward(*(mode.kept(tensor) for tensor in (query, key, value)), logsumexp)
        return torch.empty_like(query), logsumexp.clone(), nothing, sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        query, key, value, _logsumexp = ctx.saved_tensors
        ctx.mode.add_attention(query, key, backward=True)
        return *(torch.empty_like(tensor, dtype=grad.dtype) for tensor in (query, key, value)), None


class _Splat(torch.autograd.Function):
    """Returns what ``raytran::pair_mean`` does."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, num_voxels: int, mode: StandIns) -> Tensor:
        ctx.sizes, ctx.mode = (features.shape[0], num_voxels, features.shape[1]), mode
        mode.add_splat(*ctx.sizes)
        return features.new_empty(num_voxels, features.shape[1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        ctx.mode.add_splat(*ctx.sizes)
        return grad.new_empty(ctx.sizes[0], ctx.sizes[2]), None, None


def fake_copy(model: RayTran, pairs_per_pixel: float) -> RayTran:
    """Return the model with weights and pairs that have no data; to be called in a ``FakeTensorMode``."""
    tensors: dict[int, Any] = {
        id(weight): nn.Parameter(torch.empty(weight.shape, dtype=weight.dtype), weight.requires_grad)
        for weight in model.parameters()
    }
    tensors |= {id(buffer): torch.empty(buffer.shape, dtype=buffer.dtype) for buffer in model.buffers()}
    network = copy.deepcopy(model, tensors)

    def ray_tracer(
        cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int
    ) -> PairList:
        scenes, views = cameras.intrinsics.shape[:2]
        pixels = scenes * views * feature_size[0] * feature_size[1]
        return FakePairs.of(pixels, scenes * grid.num_voxels, pairs_per_pixel)

    def trace(cameras: Cameras, grid: VoxelGrid) -> PairList:
        stride, (height, width) = network.backbone.stride, cameras.image_size
        return ray_tracer(cameras, grid, (height // stride, width // stride), network.rays_per_cell)

    without_data: Any = network
    without_data.ray_tracer, without_data.trace = ray_tracer, trace
    return network


@contextmanager
def dry_network(model: RayTran, load: Load, precision: str) -> Iterator[tuple[RayTran, Tally]]:
    """Give a network without data whose work and memory are tallied while the block runs."""
    tally, dtype = Tally(), _AUTOCAST[precision]
    voxels = load.scenes * VoxelGrid(model.grid_resolution, model.grid_extent, torch.zeros(3)).num_voxels
    with FakeTensorMode(), tally, StandIns(tally, load, voxels, dtype or torch.float32):
        # The masks of fused kernels take a fortieth of what a list of pairs does: they count as nothing.
        yield fake_copy(model, 0.0 if load.fused else load.pairs_per_pixel), tally


@contextmanager
def autocast(precision: str) -> Iterator[None]:
    """Compute in one of ``PRECISIONS``."""
    dtype = _AUTOCAST[precision]
    with torch.autocast("cpu", dtype=dtype or torch.bfloat16, enabled=dtype is not None):
        yield


def backward(output: Tensor) -> None:
    """Run the backward pass with the stand-ins in force, for blocks that are computed again in it.

    ``Tensor.backward`` would suspend them, as all functions that a ``TorchFunctionMode`` could replace do.
    """
    options = {"allow_unreachable": True, "accumulate_grad": True}
    _engine_run_backward((output,), (torch.ones_like(output),), False, False, (), **options)


def dry_training(model: RayTran, load: Load, stage: Stage, *, precision: str = "32-true") -> Tally:
    """Return the memory of a training step with AdamW, that of the weights included, and its work."""
    with dry_network(model, load, precision) as (network, tally):
        stage.freeze(network)
        stage.set_modes(network)
        trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
        moments = [torch.empty_like(parameter) for parameter in trained for _ in range(2)]
        views = load.fake_views(network.backbone.encoder.input_channels)
        new_views = replace(load, views=stage.new_views).fake_views(3)
        with autocast(precision):
            raw = network(views, tasks=stage.tasks, new_cameras=Cameras.of(new_views))
            loss = _loss(network, raw, stage, new_views)
        del raw
        backward(loss)
        del moments
    tally.work.append(work_of_adamw(sum(parameter.numel() for parameter in trained)))
    return tally


def dry_prediction(
    model: RayTran, load: Load, *, views_at_once: int | None, precision: str = "32-true"
) -> Tally:
    """Return the memory of ``RayTran.predict``, that of the weights included, and its work."""
    with dry_network(model, load, precision) as (network, tally), torch.no_grad():
        network.eval()
        views = load.fake_views(network.backbone.encoder.input_channels)
        with autocast(precision):
            raw = network(views, views_at_once=views_at_once)
            masks = [logits.float().sigmoid() for logits in (raw.occupancy, raw.foreground)]
            if "shape" in network.heads:
                embedding = raw.objects[-1].embedding[0]
                masks += [network.decode_shapes(some) for some in embedding.split(SHAPES_AT_ONCE)]
    return tally


def _loss(network: RayTran, raw: RawScene, stage: Stage, new_views: Views) -> Tensor:
    """Return a scalar that depends on what the stage's loss depends on, through the same tensors."""

    def cross_entropy(logits: Tensor) -> Tensor:
        target = torch.empty(logits.shape, dtype=torch.bool)
        return F.binary_cross_entropy_with_logits(logits.float(), target.float())

    terms: list[Tensor] = []
    dense = {"occupancy": raw.occupancy, "foreground": raw.foreground}
    terms += [
        cross_entropy(logits) for name, logits in dense.items() if name in stage.terms and logits is not None
    ]
    if "view" in stage.terms and raw.new_views is not None:
        terms.append(F.mse_loss(raw.new_views.float().sigmoid(), new_views.colors()))
    # Matching depends on data; what the loss keeps of so few numbers counts nothing.
    for layer in (raw.objects or ()) if "objects" in stage.terms else ():
        terms += [x.sum() for x in (layer.class_logits, layer.center, layer.log_size, layer.yaw_vector)]
    if "shape" in stage.terms and raw.objects is not None:
        embedding = raw.objects[-1].embedding.flatten(0, 1)
        shapes = network.decode_shapes(embedding[: MATCHED_OBJECTS * raw.grid_center.shape[0]])
        terms.append(cross_entropy(shapes))
    return torch.stack([term.float() for term in terms]).sum()
