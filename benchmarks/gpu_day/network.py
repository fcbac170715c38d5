# SPDX-License-Identifier: Apache-2.0
"""Part 2, the network: losses and gradients of whole training steps on the device against the CPU's."""

from __future__ import annotations

import copy
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from device import Device
from fit import random_batch, step_config
from torch import Tensor

from gpu_day.context import Context
from raytran.model import inputs_of
from raytran.ops.traverse import Attention, RayTracer
from raytran.run.plan.camera_paths import walk
from raytran.run.train.build import build_model, build_module
from raytran.structs import SceneBatch
from raytran.training.lightning_module import Reconstruction

LOSS_TOLERANCE = 1e-4
"""Of each loss term, over its size. Weights changed in their last bit change losses by 3e-7 at most (four
presets, two stages, three seeds, on a CPU); convolutions of cuDNN may sum in other orders and forms."""

GRADIENT_TOLERANCE = 2e-2
"""Of the gradient of the backbone and of each head: norm of the error over the norm. Weights changed in their
last bit change it by 1e-6 mostly and by 5e-3 at most, where the input of a ReLU changed its sign."""

BAR = f"losses within {LOSS_TOLERANCE:.0e}, gradients within {GRADIENT_TOLERANCE:.0e}"

SMALL = ("model.grid_resolution=[8,8,4]", "views.image_size=[64,96]")
"""The small size: 3 frames of 64×96 and 256 voxels."""


def small_networks(context: Context) -> None:
    """Check each preset at a small size, in stage 2 and in stage 3."""
    for preset in context.sizes.presets:
        for stage in context.sizes.stages:
            settings = (*SMALL, *context.sizes.small)
            _compare(context, f"{preset}, {stage}, small size", preset, stage, settings, views=3, seeds=3)


def whole_network(context: Context) -> None:
    """Check the paper's preset at its full size."""
    sizes = context.sizes
    name = f"{sizes.preset}, stage2, full size"
    _compare(context, name, sizes.preset, "stage2", sizes.settings, views=sizes.views, seeds=2)


def _compare(
    context: Context,
    name: str,
    preset: str,
    stage: str,
    settings: Sequence[str],
    *,
    views: int,
    seeds: int,
) -> None:
    """Compare the fused kernels' network on the device with the CPU's, and with torch.sparse's there.

    In float32. Where two slots cost the same, or two voxels propose alike, rounding decides between them. So
    one seed of several is enough: what is wrong is wrong with all of them.
    """
    names = f"network {name}: the device against the CPU", f"network {name}: attention fused against sparse"
    with context.checks.attempt(names[0], BAR):
        told, good = [], False
        for seed in range(seeds):
            module, batch = _module_and_batch(preset, stage, settings, views, seed)
            there = copy.deepcopy(module).to(context.device.torch_device)
            batch_there = batch.to(context.device.torch_device)
            expected = losses_and_gradients(module, batch, "sparse")
            actual = losses_and_gradients(there, batch_there, "fused")
            good, words = _judge(actual, expected)
            told.append(words)
            if good:
                break
        context.checks.add(names[0], bar=BAR, measured="; then ".join(told), passed=good)
        if stage == "stage2":
            good, words = _judge(actual, losses_and_gradients(there, batch_there, "sparse"))
            context.checks.add(names[1], bar=BAR, measured=words, passed=good)


def _module_and_batch(
    preset: str, stage: str, settings: Sequence[str], views: int, seed: int
) -> tuple[Reconstruction, SceneBatch]:
    """Return a network of random weights as it trains in a stage, and a scene, both on the CPU."""
    cfg = step_config(preset, stage, Device(), settings)
    torch.manual_seed(seed)
    module = build_module(cfg, build_model(cfg, pretrained=False))
    module.stage.freeze(module.model)
    module.stage.set_modes(module.model)
    height, width = cfg.views.image_size
    cameras = walk(views).scaled_to((height, width))
    return module, random_batch(cameras, module.model, 1, module.stage.targets)


def losses_and_gradients(
    module: Reconstruction, batch: SceneBatch, attention: Attention
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Return the terms of the loss, and the gradient of every parameter that has one, on the CPU."""
    module.model.ray_tracer = RayTracer(attention)
    module.zero_grad()
    with _exact_products():
        raw = module.model(**inputs_of(batch), tasks=module.stage.tasks)
        shapes = module.model.decode_shapes
        losses = module.loss(raw, batch, terms=module.stage.terms, decode_shapes=shapes)
        losses["total"].backward()
    gradients = {
        name: parameter.grad.cpu().double()
        for name, parameter in module.model.named_parameters()
        if parameter.grad is not None
    }
    return {name: float(value.detach()) for name, value in losses.items()}, gradients


def _judge(
    actual: tuple[dict[str, float], dict[str, Tensor]], expected: tuple[dict[str, float], dict[str, Tensor]]
) -> tuple[bool, str]:
    """Return whether losses and gradients agree, and how well."""
    if actual[0].keys() != expected[0].keys() or actual[1].keys() != expected[1].keys():
        return False, "other losses, or other parameters with gradients"
    terms = [abs(actual[0][name] - value) / max(abs(value), 1e-6) for name, value in expected[0].items()]
    losses = float(torch.tensor(terms).max())  # which is no number if one of them is none
    squares: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
    for name, gradient in expected[1].items():
        part = name.removeprefix("heads.").split(".")[0]
        squares[part][0] += float((actual[1][name] - gradient).square().sum())
        squares[part][1] += float(gradient.square().sum())
    errors = {part: (error / max(size, 1e-30)) ** 0.5 for part, (error, size) in squares.items()}
    passed = losses <= LOSS_TOLERANCE and all(error <= GRADIENT_TOLERANCE for error in errors.values())
    parts = ", ".join(f"{part} {error:.1e}" for part, error in errors.items())
    return passed, f"losses {losses:.1e}, gradients {parts}"


@contextmanager
def _exact_products() -> Iterator[None]:
    """Let GPUs multiply in 32 bits and not in TF32, whose 10 bits would hide errors."""
    before = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = before
