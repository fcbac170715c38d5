# SPDX-License-Identifier: Apache-2.0
"""The pretend GPU of the tests as a device of the benchmarks: its waits and launches, no times, no memory."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from device import Device
from lightning.pytorch.accelerators import Accelerator
from lightning.pytorch.strategies import SingleDeviceStrategy

from gpu_day.context import Sizes
from raytran.ops import block_pairs

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
import pretend_device

SMALL = (
    "model.grid_resolution=[4,4,4]",
    "views.image_size=[32,48]",
    "model.backbone.channels=16",
    "model.backbone.resnet.width=8",
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
    trainer = ("trainer.accelerator=auto", "+trainer.strategy={_target_:gpu_day.pretend.one_device}")
    why_unmeasured = "the pretend device has no clock and no memory of its own"

    def __init__(self) -> None:
        pretend_device._set_up()
        block_pairs._SLOTS = 16  # the interpreter takes its time over every program, also of an unused slot
        self.torch_device = torch.device(pretend_device.DEVICE)

    def running(self) -> AbstractContextManager[object]:
        """Return the context in which everything on the device happens."""
        return pretend_device._Everything()

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


class _Accelerator(Accelerator):
    """What Lightning asks of a kind of device."""

    def setup_device(self, device: torch.device) -> None:
        """Do nothing."""

    def teardown(self) -> None:
        """Do nothing."""

    @staticmethod
    def parse_devices(devices: Any) -> Any:
        """Return what is given."""
        return devices

    @staticmethod
    def get_parallel_devices(devices: Any) -> list[torch.device]:
        """Return the one device."""
        return [torch.device(pretend_device.DEVICE)]

    @staticmethod
    def auto_device_count() -> int:
        """Return 1."""
        return 1

    @staticmethod
    def is_available() -> bool:
        """Return True."""
        return True

    @staticmethod
    def name() -> str:
        """Return the name of the kind."""
        return pretend_device.NAME


def one_device() -> SingleDeviceStrategy:
    """Return what makes Lightning's Trainer use the device."""
    return SingleDeviceStrategy(torch.device(pretend_device.DEVICE), accelerator=_Accelerator())
