# SPDX-License-Identifier: Apache-2.0
"""What fits on a device, before anything is run: ``raytran plan``; see ``conf/plan.yaml``."""

from __future__ import annotations

import logging
import os
import re
from dataclasses import dataclass, replace

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich import box
from rich.console import Console
from rich.table import Table

from raytran.backbone.backbone import Backbone
from raytran.capture.sample_scene import scene_path
from raytran.errors import ConfigError
from raytran.geometry.grid import VoxelGrid
from raytran.model import RayTran
from raytran.ops.pairs import listed
from raytran.ops.traverse import RayTracer
from raytran.run.plan.camera_paths import recorded, walk
from raytran.run.plan.dry_run import PRECISIONS, Load, dry_prediction, dry_training
from raytran.run.plan.roofline import Ceilings, measure_ceilings
from raytran.run.train.build import build_model
from raytran.training.stage import Stage

_log = logging.getLogger(__name__)

GIBIBYTE = 1 << 30

SCRATCH, FIXED = 1.3, 100 << 20
"""Peak over the tensors counted, and bytes on top, for scratch memory and fragmentation: fitted to training
and prediction of three sizes on a CPU (``benchmarks/README.md``), where no forecast is off by over 1.3."""

CONTEXT = 600 << 20
"""Bytes of a process that has done nothing yet: libraries, on a GPU its context."""


@dataclass(frozen=True)
class Need:
    """What one way to run needs.

    Attributes:
        job: ``train`` or ``predict``.
        setting: what was chosen for it, as one would type it.
        views: frames of a scene.
        memory: forecast of the peak, bytes.
        seconds: least time on a device with the ceilings given, of a step or a prediction.
    """

    job: str
    setting: str
    views: int
    memory: int
    seconds: float


def plan(cfg: DictConfig) -> list[Need]:
    """Print what training and prediction need, and which settings make them fit.

    Returns:
        Every way that was looked at, those of training first; within a job the one asked for first.

    Raises:
        ConfigError: a setting has no meaning.
        DataError: the scene's folder is missing or damaged.
    """
    device, limit = _device(cfg.gpu)
    precision = ("16-mixed" if device == "gpu" else "32-true") if cfg.precision == "auto" else cfg.precision
    if precision not in PRECISIONS:
        raise ConfigError(f"unknown precision={precision}: choose auto or one of {', '.join(PRECISIONS)}")
    model, stage = _model(cfg), instantiate(cfg.stage, _convert_="all")
    train_views = cfg.data.views or cfg.views.num_views
    predict_views = cfg.data.views or cfg.views.predict_views
    height, width = cfg.views.image_size
    stride = model.backbone.stride
    if height % stride or width % stride:
        raise ConfigError(f"views.image_size=[{height},{width}]: sides must be divisible by {stride}")
    load = Load(cfg.views.batch_size, train_views, (height, width), 0.0, fused=device == "gpu")
    load = replace(load, pairs_per_pixel=_pairs_per_pixel(cfg, model, load))
    one = replace(load, scenes=1, views=predict_views)
    _log.info(
        "a pixel sees %.1f voxels (%s): %s pairs a scene in training, %s in prediction",
        load.pairs_per_pixel,
        "made-up walk" if cfg.scene is None else cfg.scene,
        f"{_pairs(load, stride) // load.scenes:,}",
        f"{_pairs(one, stride):,}",
    )
    ceilings = _ceilings(cfg)
    needs = _training(model, load, stage, precision, ceilings)
    needs += _prediction(model, one, cfg.views_at_once, ceilings)
    Console().print(_table(needs, limit, ceilings, precision))
    for job in ("train", "predict"):
        _log.info("%s", advice([need for need in needs if need.job == job], limit))
    return needs


def parse_size(text: str) -> int:
    """Return the bytes of e.g. ``16GB`` or ``512MB``; a GB has 2³⁰ of them, as on a GPU's label.

    Raises:
        ConfigError: it is no such size.
    """
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([MG])i?B?\s*", str(text), flags=re.IGNORECASE)
    if found is None or float(found[1]) == 0:
        raise ConfigError(f"gpu={text} is no size of memory: write gpu=16GB")
    return round(float(found[1]) * (GIBIBYTE if found[2].upper() == "G" else 1 << 20))


def advice(needs: list[Need], limit: int) -> str:
    """Return one sentence: what fits, what makes it fit, or what else could be changed.

    Args:
        needs: the ways to do one job, in the order of preference.
        limit: bytes of the device.
    """
    wanted, best = needs[0], min(needs, key=lambda need: need.memory)
    what = f"{wanted.job}: {wanted.views} frames"
    fitting = next((need for need in needs if need.memory <= limit), None)
    if fitting is wanted:
        return f"{what} fit with {wanted.setting} ({_gb(wanted.memory)} of {_gb(limit)})"
    if fitting is not None:
        return (
            f"{what} do not fit with {wanted.setting} ({_gb(wanted.memory)} of {_gb(limit)}); "
            f"they do with {fitting.setting} ({_gb(fitting.memory)})"
        )
    return (
        f"{what} do not fit: {_gb(best.memory)} even with {best.setting}, there are {_gb(limit)}; "
        "use fewer frames (data.views), a coarser model.grid.resolution, or smaller views.image_size"
    )


def _model(cfg: DictConfig) -> RayTran:
    """Return the network; ``model.grid`` is this command's short form of two of its settings."""
    grid = cfg.model.grid
    resolution, extent = list(grid.resolution), list(grid.extent)
    if len(resolution) != 3 or min(resolution) < 1 or len(extent) != 3 or min(extent) <= 0:
        raise ConfigError(
            f"model.grid.resolution={resolution} and model.grid.extent={extent} must be "
            "three numbers above 0 each"
        )
    cfg = cfg.copy()
    del cfg.model.grid
    cfg.model.grid_resolution, cfg.model.grid_extent = resolution, extent
    model = build_model(cfg, pretrained=False)
    model.ray_tracer = RayTracer()  # whatever the config says: here rays are traced to be counted
    return model


def _device(gpu: str | None) -> tuple[str, int]:
    """Return ``gpu`` or ``cpu``, and the bytes of its memory."""
    if gpu is not None:
        return "gpu", parse_size(gpu)
    if torch.cuda.is_available():
        return "gpu", torch.cuda.get_device_properties(0).total_memory
    return "cpu", os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _pairs_per_pixel(cfg: DictConfig, model: RayTran, load: Load) -> float:
    """Trace the rays of as many cameras as are trained with, and return the voxels that a pixel sees."""
    views = load.views
    cameras = walk(views) if cfg.scene is None else recorded(scene_path(cfg.scene), views)
    grid = VoxelGrid(model.grid_resolution, model.grid_extent, cameras.position.mean(dim=0))
    pairs = listed(model.trace(cameras.scaled_to(load.image_size), grid))
    return len(pairs) / pairs.num_pixels


def _pairs(load: Load, stride: int) -> int:
    cells = load.image_size[0] * load.image_size[1] // stride**2
    return round(load.scenes * load.views * cells * load.pairs_per_pixel)


def _ceilings(cfg: DictConfig) -> Ceilings:
    if cfg.ceilings is None:
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return measure_ceilings(device, torch.float16 if device.type == "cuda" else torch.float32)
    if len(cfg.ceilings) != 2 or min(cfg.ceilings) <= 0:
        raise ConfigError("ceilings must be two numbers above 0, TFLOP/s and GB/s: write ceilings=[100,900]")
    return Ceilings(1e12 * cfg.ceilings[0], 1e9 * cfg.ceilings[1])


def _training(model: RayTran, load: Load, stage: Stage, precision: str, ceilings: Ceilings) -> list[Need]:
    """Return what a training step needs, without and with activation checkpointing."""
    backbone = model.backbone
    if not isinstance(backbone, Backbone):
        tally = dry_training(model, load, stage, precision=precision)
        return [Need("train", "everything kept", load.views, _peak(tally.peak), tally.seconds(ceilings))]
    needs = []
    for repeat in dict.fromkeys((backbone.checkpoint_blocks, True)):
        backbone.checkpoint_blocks = repeat
        tally = dry_training(model, load, stage, precision=precision)
        setting = f"model.backbone.checkpoint_blocks={str(repeat).lower()}"
        needs.append(Need("train", setting, load.views, _peak(tally.peak), tally.seconds(ceilings)))
    return needs


def _prediction(model: RayTran, load: Load, views_at_once: int | None, ceilings: Ceilings) -> list[Need]:
    """Return what a prediction in 32 bit needs, with all frames at once or with fewer."""
    needs = []
    for count in dict.fromkeys((views_at_once, None, 16, 4)):
        tally = dry_prediction(model, load, views_at_once=count)
        setting = f"views_at_once={'null' if count is None else count}"
        needs.append(Need("predict", setting, load.views, _peak(tally.peak), tally.seconds(ceilings)))
    return needs


def _peak(tensors: int) -> int:
    return round(SCRATCH * tensors) + FIXED + CONTEXT


def _gb(size: float) -> str:
    return f"{size / GIBIBYTE:.1f} GB"


def _table(needs: list[Need], limit: int, ceilings: Ceilings, precision: str) -> Table:
    """Return all ways as a table for the terminal."""
    table = Table("", "frames", "setting", "peak", "least time", "fits", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in table.columns:
        column.no_wrap = True
    table.caption = (
        f"training in {precision}, prediction in 32-true; least time at "
        f"{ceilings.operations_per_second / 1e12:.2f} TFLOP/s and {ceilings.bytes_per_second / 1e9:.0f} GB/s"
    )
    for need in needs:
        fits = "yes" if need.memory <= limit else "no"
        time = f"{need.seconds:.2f} s" if need.seconds > 1 else f"{1e3 * need.seconds:.1f} ms"
        table.add_row(need.job, str(need.views), need.setting.rsplit(".")[-1], _gb(need.memory), time, fits)
    return table
