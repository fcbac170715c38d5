# SPDX-License-Identifier: Apache-2.0
"""Training steps as ``raytran.train`` takes them, on random scenes: their time, memory, waits and launches.

The Trainer, its precision, the callbacks of every run and the stage are those of a real run; only the scenes
are made up, and the same in every step. So what Lightning and the callbacks cost is in the figures.
"""

from __future__ import annotations

import logging
import math
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import lightning.pytorch as pl
import torch
from device import Device
from omegaconf import DictConfig
from torch.utils.data import DataLoader

from raytran.data.dataset import TARGETS
from raytran.geometry.camera import Cameras
from raytran.geometry.rotation import rotation_from_yaw
from raytran.model import RayTran
from raytran.run.entry import compose
from raytran.run.train.build import build_model, build_module, build_trainer, plain
from raytran.run.train.settings import RunConfig
from raytran.structs import SHAPE_SIZE, ObjectSet, SceneBatch, Views
from raytran.training.callbacks.stage import StageCallback

WARM_UP = 5
"""Steps before anything is measured."""


@dataclass(frozen=True)
class Steps:
    """What training steps took.

    Attributes:
        seconds: median time of a step.
        peak: most bytes at any moment since the device was empty: weights, gradients, moments, all of it.
        waits: where the host waited for the device in one step, a line for each time.
        launches: kernels that one step launched; None if nobody counted.
        losses: the total of each step.
        precision: that the Trainer chose.
        first_rank: False on further ranks of a parallel run, which should say nothing.
    """

    seconds: float
    peak: int
    waits: list[str]
    launches: int | None
    losses: list[float]
    precision: str
    first_rank: bool


def step_config(preset: str, stage: str, device: Device, settings: Sequence[str] = ()) -> DictConfig:
    """Return the config of a run with a preset and a stage on a device; later settings win."""
    fixed = [f"preset={preset}", f"experiment={stage}", "output_dir=unused", "progress_bar=none"]
    ours = ["watch.pictures=0", "logger=csv", f"model.attention={device.attention}"]
    # Each rank takes the same scenes: Lightning would share them out.
    ours.append("+trainer.use_distributed_sampler=false")
    return compose("train", [*fixed, *ours, *device.trainer, *settings])


def run_steps(
    cfg: DictConfig,
    cameras: Cameras,
    device: Device,
    *,
    timed: int,
    warm_up: int = WARM_UP,
    clock: Callable[[], float] = time.perf_counter,
) -> Steps:
    """Train: steps to warm up, one whose waits are collected, those timed, one whose launches are counted.

    Args:
        cfg: of the run, from ``step_config``.
        cameras: of the frames of a scene, ``(N,)``, for images of ``views.image_size``.
        device: which must be empty for the peak to be that of the run.
        timed: steps of which the median is taken.
        warm_up: steps before.
        clock: seconds; every step waits for the device once, so that the host's clock does.
    """
    held = device.held()
    torch.manual_seed(cfg.seed)
    with tempfile.TemporaryDirectory() as folder:
        cfg = cfg.copy()
        cfg.output_dir, cfg.trainer.max_steps = folder, warm_up + timed + 2
        module = build_module(cfg, build_model(cfg, pretrained=False))
        batch = random_batch(cameras, module.model, cfg.views.batch_size, module.stage.targets)
        metadata = {"stage": module.stage.name, "preset": cfg.preset, "config": plain(cfg)}
        trainer = build_trainer(cfg, RunConfig.read(cfg), metadata, StageCallback())
        device.adopt(trainer)
        watch = _Watch(device, warm_up, timed, clock)
        trainer.callbacks.append(watch)
        if device.torch_device.type != "cpu":
            batch = batch.pin_memory()  # as the loader of a run does
        scenes: list[Any] = [batch] * cfg.trainer.max_steps
        with _quiet(), device.counting():
            trainer.fit(module, DataLoader(scenes, batch_size=None))
    return Steps(
        seconds=statistics.median(watch.seconds) if watch.seconds else math.nan,
        peak=device.peak() - held,
        waits=watch.waits,
        launches=watch.launches,
        losses=[float(loss) for loss in watch.losses],
        precision=str(trainer.precision),
        first_rank=trainer.is_global_zero,
    )


class _Watch(pl.Callback):
    """Measures from the end of a step to the end of the next: the batch's way to the device is in it."""

    def __init__(self, device: Device, warm_up: int, timed: int, clock: Callable[[], float]) -> None:
        self._device, self._clock = device, clock
        self._waits_after, self._time_after, self._launches_after = warm_up, warm_up + 1, warm_up + 1 + timed
        self._open = ExitStack()
        self._began = 0.0
        self._count: list[int] = []
        self.waits: list[str] = []
        self.seconds: list[float] = []
        self.losses: list[torch.Tensor] = []

    @property
    def launches(self) -> int | None:
        """Kernels of the last step."""
        return self._count[0] if self._count else None

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Close the measure of this step and open that of the next."""
        now, done = self._clock(), batch_idx + 1
        self._open.close()
        if self._time_after < done <= self._launches_after:
            self.seconds.append(now - self._began)
        self._began = now
        self.losses.append(outputs["losses"]["total"])
        if done == self._waits_after:
            self.waits = self._open.enter_context(self._device.waits())
        elif done == self._launches_after:
            self._count = self._open.enter_context(self._device.launches())
        if done in (self._time_after, self._launches_after):
            self._began = self._clock()

    def on_exception(self, trainer: pl.Trainer, pl_module: Any, exception: BaseException) -> None:
        """Leave the device as it was."""
        self._open.close()


def random_batch(
    cameras: Cameras, model: RayTran, scenes: int, targets: Collection[str] = TARGETS
) -> SceneBatch:
    """Return ``scenes`` equal scenes of random images with ten objects each, and the targets asked for."""
    views = len(cameras.intrinsics)
    lead, size = (scenes, views), cameras.image_size
    images = torch.randint(0, 256, (*lead, model.backbone.encoder.input_channels, *size), dtype=torch.uint8)
    poses = (cameras.intrinsics.float(), cameras.world_from_camera.float())
    center = cameras.position.float().mean(dim=0)
    objects = ObjectSet(
        label=torch.randint(0, 9, (10,)),
        center=center + torch.randn(10, 3),
        size=torch.rand(10, 3) + 0.3,
        rotation=rotation_from_yaw(6.3 * torch.rand(10)),
        symmetry=torch.ones(10, dtype=torch.int64),
        score=torch.ones(10),
        shape=torch.rand(10, *[SHAPE_SIZE] * 3) > 0.5 if "shapes" in targets else None,
        model_id=("03001627/a",) * 10,
    )
    return SceneBatch(
        tuple(f"scene{number}" for number in range(scenes)),
        Views(images, *(pose.repeat(scenes, 1, 1, 1) for pose in poses)),
        ((),) * scenes,
        center.repeat(scenes, 1),
        (objects,) * scenes if {"objects", "shapes"} & set(targets) else None,
        torch.rand(scenes, *model.grid_resolution) > 0.95 if "occupancy" in targets else None,
        torch.rand(*lead, *size) > 0.7 if "foreground" in targets else None,
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence what is said of a run that is no real one."""
    names = ("raytran", "lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero")
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"lightning\.")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
