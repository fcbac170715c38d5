# SPDX-License-Identifier: Apache-2.0
"""The pretend GPU of the tests as a device of the benchmarks: its waits and launches, no times, no memory."""

from __future__ import annotations

import sys
import types
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from pathlib import Path

import lightning.pytorch as pl
import torch
from device import Device

from gpu_day.context import Sizes
from raytran.ops.triton import block_pairs

# Tests import each other from the package that pytest makes of their folder.
sys.modules["tests"] = types.ModuleType("tests")
sys.modules["tests"].__path__ = [str(Path(__file__).resolve().parents[2] / "tests")]
pretend_device = import_module("tests.pretend_device")
register_with_lightning = import_module("tests.pretend_accelerator").register_with_lightning

SMALL = (
    "model.grid_resolution=[4,4,4]",
    "views.image_size=[32,48]",
    "model.backbone.channels=16",
    "model.backbone.encoder.width=8",
    "model.heads.objects.hidden=16",
    "model.heads.shape.widths=[8,8,8,8]",
)
"""A network so small; the number of its layers is the preset's."""

CUT = Sizes(
    preset="tiny",
    settings=SMALL,
    views=2,
    many_views=3,
    feature_size=(2, 4),
    grid=(2, 4, 4),
    dense_pixels=(1, 3, 9),
    dense_grid=(4, 5, 3),
    dtypes=(torch.float32,),
    heads=1,
    widths=(),
    probes=1,
    presets=("tiny",),
    stages=("stage2",),
    small=SMALL,
    baselines=("gather",),
    rounds=1,
    steps=1,
    warm_up=1,
    precisions=("32-true",),
    training=(
        "rooms.num_train=2",
        "rooms.num_val=1",
        "rooms.frames=6",
        "rooms.image_size=[64,64]",
        "rooms.max_objects=3",
        "rooms.processes=1",
        "views.image_size=[64,64]",
        "views.num_views=3",
        "views.predict_views=3",
        "views.batch_size=1",
        "model.grid_resolution=[8,8,4]",
        "trainer.max_steps=6",
        "trainer.val_check_interval=6",
        "schedule.log_every=1",
        "checkpoint_every=2",
    ),
    killed=(),
    losses={"stage1": 1e3, "stage2": 1e3, "stage3": 1e3},
    score=0.0,
    prediction=("check=false", "turntable=0", "num_overlays=1"),
)
"""A minute of one core; six steps learn nothing, so that losses and scores pass if there are any."""


class PretendGpu(Device):
    """A device that is none: its kernels run in Triton's interpreter."""

    attention = "fused"
    trainer = (
        f"trainer.accelerator={pretend_device.NAME}",
        f"trainer.strategy={pretend_device.NAME}",
        "precision=bf16-mixed",
    )
    why_unmeasured = "the pretend device has no clock and no memory of its own"

    def __init__(self) -> None:
        pretend_device.set_up()
        register_with_lightning()
        block_pairs._SLOTS = 16  # the interpreter takes its time over every program, also of an unused slot
        self.torch_device = torch.device(pretend_device.DEVICE)

    def running(self) -> AbstractContextManager[object]:
        """Return the context in which everything on the device happens."""
        return pretend_device.Everything()

    def counting(self) -> AbstractContextManager[object]:
        """Leave the kernels out: they count as before."""
        return pretend_device.kernels_left_out()

    def adopt(self, trainer: pl.Trainer) -> None:
        """Let autocast know the device."""
        trainer.precision_plugin.device = pretend_device.NAME

    @contextmanager
    def waits(self) -> Iterator[list[str]]:
        """Collect what the device notes."""
        found: list[str] = []
        with pretend_device.recorded() as seen:
            yield found
        found += seen.waits.elements()

    @contextmanager
    def launches(self) -> Iterator[list[int]]:
        """Count what the device notes."""
        count: list[int] = []
        with pretend_device.recorded() as seen:
            yield count
        count.append(seen.launches.total())
