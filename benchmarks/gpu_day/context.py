# SPDX-License-Identifier: Apache-2.0
"""What every part is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from device import Device

from gpu_day.checks import Checks


@dataclass(frozen=True)
class Sizes:
    """How much of everything; the defaults are those of a day with a GPU.

    Attributes:
        preset: of the network that is measured; waits are always those of the paper's.
        settings: more settings of it.
        views: frames of a scene in training.
        many_views: frames of a scene in prediction.
        feature_size: ``(h, w)`` of the maps that the operators are measured on.
        grid: voxels that they are measured on.
        dense_pixels: ``(views, h, w)`` of maps on which they are compared with the dense twin.
        dense_grid: voxels on which they are.
        dtypes: of features there.
        heads: of attention there.
        widths: channels of a head to try besides the paper's 32.
        probes: random directions of each finite difference.
        presets: networks that are compared with the CPU at a small size.
        stages: in which they are.
        small: more settings of these.
        baselines: what attention is timed against.
        rounds: how often a time is taken.
        steps: training steps of which the time is taken.
        warm_up: steps before.
        precisions: in which the tiny curriculum is trained.
        training: settings of it on top of its preset's.
        killed: more settings of the run that is killed.
        losses: for each stage what its loss must come down to; ``benchmarks/README.md`` says from which runs.
        score: F1 at IoU 0.25 on its training rooms that a curriculum must reach; from the same runs.
        prediction: settings of ``raytran.predict``.
    """

    preset: str = "raytran"
    settings: tuple[str, ...] = ()
    views: int = 20
    many_views: int = 96
    feature_size: tuple[int, int] = (30, 40)
    grid: tuple[int, int, int] = (48, 48, 16)
    dense_pixels: tuple[int, int, int] = (4, 15, 20)
    dense_grid: tuple[int, int, int] = (18, 18, 7)
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float16, torch.bfloat16)
    heads: int = 8
    widths: tuple[int, ...] = (16, 64, 128)
    probes: int = 4
    presets: tuple[str, ...] = ("raytran", "small", "laptop", "tiny")
    stages: tuple[str, ...] = ("stage2", "stage3")
    small: tuple[str, ...] = ()
    baselines: tuple[str, ...] = ("gather", "flex")
    rounds: int = 15
    steps: int = 30
    warm_up: int = 3
    precisions: tuple[str, ...] = ("bf16-mixed", "16-mixed")
    training: tuple[str, ...] = ()
    killed: tuple[str, ...] = ("checkpoint_every=50",)
    losses: Mapping[str, float] = field(default_factory=lambda: {"stage1": 1.2, "stage2": 5.0, "stage3": 0.6})
    score: float = 0.8
    prediction: tuple[str, ...] = ()


@dataclass(frozen=True)
class Context:
    """Where a step of a part works.

    Attributes:
        checks: what it finds.
        device: that it looks at.
        sizes: how much of everything.
        output: folder of the report.
    """

    checks: Checks
    device: Device
    sizes: Sizes
    output: Path
