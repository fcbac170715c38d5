# SPDX-License-Identifier: Apache-2.0
"""What a training step and a prediction need: bytes by a dry run, work by a count."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from raytran.geometry.camera import Cameras
from raytran.losses.terms import foreground_loss, occupancy_loss, view_loss
from raytran.model import SHAPES_AT_ONCE, RayTran
from raytran.ops.pairs import PairList
from raytran.run.plan.count import Work, count_part
from raytran.run.plan.dry_run import LiveMemory, fake_copy, peak_bytes, stand_ins
from raytran.run.plan.step_parts import step_parts
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

    def fake_pairs(self, model: RayTran) -> PairList:
        """Return pairs without data; to be called in a ``FakeTensorMode``."""
        pixels = self.scenes * self.views * self.image_size[0] * self.image_size[1]
        pixels //= model.backbone.stride**2
        index = torch.empty(round(pixels * self.pairs_per_pixel), dtype=torch.int64)
        x, y, z = model.grid_resolution
        return PairList(index, index, pixels, self.scenes * x * y * z)


def training_bytes(model: RayTran, load: Load, stage: Stage, *, precision: str = "32-true") -> int:
    """Return the most bytes of tensors alive in a training step with AdamW, that of the weights included."""

    def run(memory: LiveMemory) -> None:
        network = fake_copy(model)
        stage.freeze(network)
        stage.set_modes(network)
        memory.track(list(network.parameters()))
        trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
        moments = [torch.empty_like(parameter) for parameter in trained for _ in range(2)]
        views = load.fake_views(network.backbone.encoder.input_channels)
        new_views = replace(load, views=stage.new_views).fake_views(3)
        with stand_ins(load.pairs_per_pixel, fused=load.fused):
            with _precision(precision):
                raw = network(views, tasks=stage.tasks, new_cameras=Cameras.of(new_views))
                loss = _loss(network, raw, stage, new_views)
            loss.backward()
        del moments

    return peak_bytes(run)


def prediction_bytes(
    model: RayTran, load: Load, *, views_at_once: int | None, precision: str = "32-true"
) -> int:
    """Return the most bytes of tensors alive in ``RayTran.predict``, that of the weights included."""

    def run(memory: LiveMemory) -> None:
        network = fake_copy(model).eval()
        memory.track(list(network.parameters()))
        views = load.fake_views(network.backbone.encoder.input_channels)
        with stand_ins(load.pairs_per_pixel, fused=load.fused), _precision(precision), torch.no_grad():
            raw = network(views, views_at_once=views_at_once)
            masks = [logits.float().sigmoid() for logits in (raw.occupancy, raw.foreground)]
            if "shape" in network.heads:
                embedding = raw.objects[-1].embedding[0]
                masks += [network.decode_shapes(some) for some in embedding.split(SHAPES_AT_ONCE)]

    return peak_bytes(run)


def work_of_parts(
    model: RayTran, load: Load, *, training: bool, precision: str = "32-true", stage: Stage | None = None
) -> dict[str, Work]:
    """Return the work of each part of a training step (losses apart), or of a prediction.

    Args:
        model: the network.
        load: the size of the step.
        training: the backward pass and the optimiser too.
        precision: of the features.
        stage: whose heads run; None for all.
    """
    found: dict[str, Work] = {}
    with FakeTensorMode(), _precision(precision):
        network = fake_copy(model).train(training).requires_grad_(training)
        views, pairs = load.fake_views(network.backbone.encoder.input_channels), load.fake_pairs(network)
        parts = step_parts(network, views, pairs, **({} if stage is None else {"tasks": stage.tasks}))
        size = 4 if _AUTOCAST[precision] is None else 2
        for part in parts:
            work = count_part(part, network, pairs, element_bytes=size, training=training)
            found[part.name] = work * part.times
        if training:
            weights = sum(parameter.numel() for parameter in network.parameters())
            # Gradient norm and AdamW: 4 reads and 3 writes of 4 bytes, the norm one more read.
            found["optimiser"] = Work(15.0 * weights, 32.0 * weights)
    return found


@contextmanager
def _precision(name: str) -> Iterator[None]:
    dtype = _AUTOCAST[name]
    with torch.autocast("cpu", dtype=dtype or torch.bfloat16, enabled=dtype is not None):
        yield


def _loss(network: RayTran, raw: RawScene, stage: Stage, new_views: Views) -> Tensor:
    """Return a scalar that depends on what the stage's loss depends on, through the same tensors."""
    terms: list[Tensor] = []
    dense: dict[str, tuple[Tensor | None, Callable[[Tensor, Tensor], Tensor]]] = {
        "occupancy": (raw.occupancy, occupancy_loss),
        "foreground": (raw.foreground, foreground_loss),
    }
    for logits, function in (dense[name] for name in stage.terms if name in dense):
        if logits is not None:
            terms.append(function(logits, torch.empty(logits.shape, dtype=torch.bool)))
    if "view" in stage.terms and raw.new_views is not None:
        terms.append(view_loss(raw.new_views, new_views))
    for layer in (raw.objects or ()) if "objects" in stage.terms else ():
        terms += [x.sum() for x in (layer.class_logits, layer.center, layer.log_size, layer.yaw_vector)]
    if "shape" in stage.terms and raw.objects is not None:
        embedding = raw.objects[-1].embedding.flatten(0, 1)
        shapes = network.decode_shapes(embedding[: MATCHED_OBJECTS * raw.grid_center.shape[0]])
        terms.append(occupancy_loss(shapes, torch.empty(shapes.shape, dtype=torch.bool)))
    return torch.stack([term.float() for term in terms]).sum()
