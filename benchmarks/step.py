# SPDX-License-Identifier: Apache-2.0
"""Each part of a training step: what it must cost, what it costs, and the gap: ``python benchmarks/step.py``.

The floor of a part is the higher of two times: its operations at the speed of a large matrix product, its
least bytes at the speed of a large copy, both measured first. Losses and optimiser count in the whole step,
which is taken through the Trainer from an empty device on: its peak has weights, gradients and moments in it.

``--stage stage1|stage2|stage3`` chooses the stage; of stage 3, most of which is frozen, only the whole step
is measured. ``--whole trainer=ddp trainer.devices=8`` takes the step of several GPUs. The loader is not in
it: see ``loader.py``.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from camera_path import add_arguments, cameras_of
from device import Device, this_device
from fit import Steps, random_batch, run_steps, step_config
from hydra.utils import instantiate
from omegaconf import DictConfig
from part_work import work_of_parts
from record import write_rows
from step_parts import Part, step_parts
from timing import MEBIBYTE, measure, print_machine, reason
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.model import RayTran
from raytran.ops.pairs import listed
from raytran.ops.traverse import RayTracer
from raytran.run.plan.dry_run import Load, dry_training
from raytran.run.plan.plan import FIXED, SCRATCH
from raytran.run.plan.roofline import Ceilings, measure_ceilings
from raytran.run.train.build import build_model, choose_precision
from raytran.structs import Views
from raytran.training.stage import Stage

Clock = Callable[[], float] | None
"""Seconds; None is the wall clock, which waits for a GPU."""

_DTYPES = {"bf16-mixed": torch.bfloat16, "16-mixed": torch.float16, "32-true": torch.float32}


def main() -> None:
    """Measure and print the whole step, then the parts, slowest first."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, rounds=5)
    parser.add_argument("--preset", default="raytran", choices=("raytran", "small", "laptop", "tiny"))
    parser.add_argument("--stage", default="stage2", choices=("stage1", "stage2", "stage3"))
    parser.add_argument("--views", type=int, help="frames of a scene; the preset's without it")
    parser.add_argument("--whole", action="store_true", help="the whole step alone")
    parser.add_argument("--count", action="store_true", help="measure nothing but the ceilings")
    parser.add_argument(
        "--ceilings", type=float, nargs=2, metavar=("TFLOP/S", "GB/S"), help="of another machine, for --count"
    )
    parser.add_argument(
        "--cpu-time", action="store_true", help="this process's own time, one thread: for a busy machine"
    )
    parser.add_argument("--json", type=Path, help="file for all that is found of the whole step")
    parser.add_argument("settings", nargs="*", help="more settings of conf/train.yaml, key=value")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    clock = time.process_time if arguments.cpu_time else None
    if arguments.cpu_time:
        torch.set_num_threads(1)
    device = this_device()
    cfg = step_config(arguments.preset, arguments.stage, device, arguments.settings)
    count, size = arguments.views or cfg.views.num_views, tuple(cfg.views.image_size)
    cameras = cameras_of(arguments, count).scaled_to(size)
    print_machine()
    rows = []
    if not arguments.count:
        # First, while the device is empty.
        rows.append(measure_step(cfg, cameras, device, arguments, clock))
        print_step(rows[0])
    if not arguments.whole and arguments.stage != "stage3":
        rows = measure_parts(cfg, cameras, device, arguments, clock) + rows
    if arguments.output:
        about = {"preset": arguments.preset, "stage": arguments.stage, "views": count}
        about |= {
            "settings": " ".join(arguments.settings),
            "clock": "process" if arguments.cpu_time else "wall",
        }
        suffix = "" if arguments.stage == "stage2" else f"-{arguments.stage}"
        path = arguments.output / f"step-{arguments.preset}{suffix}.csv"
        write_rows(path, [about | row for row in rows])


def measure_step(
    cfg: DictConfig, cameras: Cameras, device: Device, arguments: argparse.Namespace, clock: Clock
) -> dict[str, Any]:
    """Return time and memory of the whole step, losses and optimiser included, and the planner's forecast."""
    row: dict[str, Any] = {"part": "whole step", "times": 1}
    try:
        steps = run_steps(cfg, cameras, device, timed=4 * arguments.rounds, clock=clock or time.perf_counter)
    except Exception as error:  # whatever it is, the parts may still run
        return row | {"error": reason(error)}
    if not steps.first_rank:
        raise SystemExit(0)
    forecast = forecast_bytes(cfg, cameras, device, steps.precision)
    if arguments.json:
        arguments.json.write_text(json.dumps(asdict(steps) | {"forecast": forecast}))
    return row | _step_columns(steps) | {"forecast_mib": forecast / MEBIBYTE}


def _step_columns(steps: Steps) -> dict[str, Any]:
    found = {"seconds": steps.seconds, "peak_mib": steps.peak / MEBIBYTE, "precision": steps.precision}
    return found | {"waits": len(steps.waits), "launches": steps.launches}


def forecast_bytes(cfg: DictConfig, cameras: Cameras, device: Device, precision: str) -> int:
    """Return ``raytran.plan``'s forecast of the peak, without what a process has that has done nothing."""
    model = build_model(cfg, pretrained=False)
    model.ray_tracer = RayTracer()  # the dry run is one on the CPU
    load = load_of(model, cameras, cfg.views.batch_size, device)
    stage: Stage = instantiate(cfg.stage, _convert_="all")
    return round(SCRATCH * dry_training(model, load, stage, precision=precision).peak) + FIXED


def load_of(model: RayTran, cameras: Cameras, scenes: int, device: Device) -> Load:
    """Return the size of a step or a prediction, as the planner wants it."""
    grid = VoxelGrid(model.grid_resolution, model.grid_extent, cameras.position.mean(dim=0))
    pairs = listed(model.trace(cameras, grid))
    per_pixel = len(pairs) / pairs.num_pixels
    fused = device.torch_device.type != "cpu"
    return Load(scenes, len(cameras.intrinsics), cameras.image_size, per_pixel, fused=fused)


def print_step(row: dict[str, Any]) -> None:
    """Print the whole step."""
    if "error" in row:
        print(f"{'whole step':32s} does not run here: {row['error']}")
        return
    print(
        f"{'whole step':32s} {1e3 * row['seconds']:10.1f} ms, {1 / row['seconds']:.2f} steps/s in "
        f"{row['precision']}, peak {row['peak_mib']:.0f} MiB (forecast {row['forecast_mib']:.0f})"
    )


def measure_parts(
    cfg: DictConfig, cameras: Cameras, device: Device, arguments: argparse.Namespace, clock: Clock
) -> list[dict[str, Any]]:
    """Return and print what each part must cost, and unless ``--count`` what it takes."""
    precision = choose_precision(str(cfg.precision), on_cpu=device.torch_device.type == "cpu")
    if arguments.ceilings:
        ceilings = Ceilings(1e12 * arguments.ceilings[0], 1e9 * arguments.ceilings[1])
        precision = "bf16-mixed"
    else:
        ceilings = measure_ceilings(device.torch_device, _DTYPES[precision], clock or time.perf_counter)
    model = build_model(cfg, pretrained=False).to(device.torch_device).train()
    stage: Stage = instantiate(cfg.stage, _convert_="all")
    stage.freeze(model)
    views = random_batch(cameras, model, cfg.views.batch_size).views.to(device.torch_device)
    rows, parts = count_parts(model, views, stage, ceilings, precision, device)
    if not arguments.count:
        runs = {part.name: partial(train_part, part, _DTYPES[precision], device) for part in parts}
        for (name, taken), row, part in zip(
            measure(runs, arguments.rounds, device, clock=clock).items(), rows, parts, strict=True
        ):
            if taken.error:
                row |= {"error": taken.error}
                print(f"{name}: does not run here: {taken.error}")
            else:
                row |= {"seconds": part.times * taken.seconds, "peak_mib": taken.peak / MEBIBYTE}
    print_parts(rows)
    return rows


def count_parts(
    model: RayTran, views: Views, stage: Stage, ceilings: Ceilings, precision: str, device: Device
) -> tuple[list[dict[str, Any]], list[Part]]:
    """Return what every part must cost, and the parts."""
    cameras = Cameras.of(views)
    grid = VoxelGrid(model.grid_resolution, model.grid_extent, cameras.position.mean(dim=1))
    pairs = model.trace(cameras, grid)
    count = len(listed(pairs))
    tera, giga = ceilings.operations_per_second / 1e12, ceilings.bytes_per_second / 1e9
    print(f"ceilings: {tera:.3g} TFLOP/s, {giga:.4g} GB/s; {count:,} pairs; {precision}")
    fused = device.torch_device.type != "cpu"
    load = Load(*views.images.shape[:2], views.image_size, count / pairs.num_pixels, fused)
    work = work_of_parts(model, load, precision=precision, stage=stage)
    parts = step_parts(model, views, pairs, tasks=stage.tasks)
    rows = [
        {
            "part": part.name,
            "times": part.times,
            "operations": work[part.name].operations,
            "least_bytes": work[part.name].bytes,
            "operations_per_second": ceilings.operations_per_second,
            "bytes_per_second": ceilings.bytes_per_second,
            "floor_s": work[part.name].seconds(ceilings),
        }
        for part in parts
    ]
    return rows, parts


def print_parts(rows: list[dict[str, Any]]) -> None:
    """Print the parts, those that take longest first."""
    for row in sorted(rows, key=lambda row: -(row.get("seconds") or row["floor_s"])):
        print(
            f"{row['part']:31s} ×{row['times']} {row['operations'] / 1e9:8.1f} GFLOP"
            f" {row['least_bytes'] / 1e6:8.1f} MB  floor {1e3 * row['floor_s']:9.2f} ms",
            end="",
        )
        if "seconds" in row:
            gap = row["seconds"] / row["floor_s"]
            print(f"  taken {1e3 * row['seconds']:9.2f} ms {gap:6.1f}× {row['peak_mib']:6.0f} MiB", end="")
        print()
    total = sum(row["floor_s"] for row in rows)
    print(f"{'all parts':31s}    {sum(row['operations'] for row in rows) / 1e9:8.1f} GFLOP", end="")
    print(f" {sum(row['least_bytes'] for row in rows) / 1e6:8.1f} MB  floor {1e3 * total:9.2f} ms")


def train_part(part: Part, dtype: torch.dtype, device: Device) -> None:
    """Run a part forward and backward."""
    with _autocast(dtype, device):
        out = part.run()
    if isinstance(out, Tensor):
        out.backward(torch.ones_like(out))


def _autocast(dtype: torch.dtype, device: Device) -> AbstractContextManager[None]:
    return torch.autocast(device.torch_device.type, dtype=dtype, enabled=dtype != torch.float32)


if __name__ == "__main__":
    main()
