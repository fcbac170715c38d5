# SPDX-License-Identifier: Apache-2.0
"""Part 5: the bars of speed and memory on a GPU. MB and GB are 10⁶ and 10⁹ bytes."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import box_iou
import torch
from camera_path import paper_grid
from device import Device
from fit import run_steps, step_config
from prediction import predict_once
from ray_attention import BASELINES, JOBS, Case, measure_case, train
from step import forecast_bytes
from timing import MEBIBYTE, Taken, measure, median_seconds
from traversal import tracers

from gpu_day.context import Context
from raytran.geometry.boxes import OrientedBoxes
from raytran.geometry.boxes import box_iou as exact_iou
from raytran.geometry.camera import Cameras
from raytran.ops.ray_attention import Direction
from raytran.run.plan.camera_paths import walk
from raytran.run.plan.roofline import measure_ceilings

TRAVERSAL_MS, STEP_MS = 3.0, 25.0
"""On an H200; the second is aimed at."""

FLEX, GATHER, BOUND = 2.0, 10.0, 3.0
"""How often faster than FlexAttention and than gather-segment, how often slower than the bytes alone."""

ATTENTION_MB, STEP_GB, PREDICTION_GB = 64.0, 8.0, 6.0
FORECAST = 0.3
"""By what share of the measured peak the planner's forecast may be off."""

AT_ONCE = 16
"""Frames that pass through the network together in a prediction, the commands' default."""


def traversal(context: Context) -> None:
    """Time the traversal, as called: the host waits for the number of block pairs."""
    name, bar = f"traversal, {context.sizes.views} frames", f"≤ {TRAVERSAL_MS:g} ms on an H200"
    with context.checks.attempt(name, bar):
        cameras = _on(walk(context.sizes.views), context.device)
        runs = tracers(cameras, context.device, context.sizes.feature_size, context.sizes.grid)
        taken = _unless_failed(measure(runs, context.sizes.rounds, context.device)["2×2 rays a cell"])
        milliseconds = None if taken.seconds is None else 1e3 * taken.seconds
        good = None if _other_gpu(context.device) else lambda ms: ms <= TRAVERSAL_MS
        context.checks.measured(
            context.device,
            name,
            milliseconds,
            lambda ms: f"{ms:.2f} ms{_other_gpu(context.device)}",
            bar=bar,
            good=good,
        )


def attention_to_voxels(context: Context) -> None:
    """Check attention of voxels to pixels; a process of its own, like all that may break a device."""
    _attention(context, "pixels_to_voxels")


def attention_to_pixels(context: Context) -> None:
    """Check attention of pixels to voxels."""
    _attention(context, "voxels_to_pixels")


def _attention(context: Context, direction: Direction) -> None:
    """Time attention of one direction, forward and backward in bfloat16, against what else one could use."""
    what = f"attention {direction.replace('_', ' ')}, forward and backward"
    with context.checks.attempt(what):
        case = _case(context, direction, context.sizes.views)
        bandwidth = measure_ceilings(context.device.torch_device).bytes_per_second
        rows = measure_case(
            case, list(context.sizes.baselines), 1.0, context.sizes.rounds, bandwidth, JOBS[1:]
        )
        both = {row["what"]: row for row in rows if row["job"] == JOBS[1]}
        ours = both["ray_attention"]
        if ours["error"]:
            raise RuntimeError(ours["error"])
        alone = 1e3 * (ours["device_seconds"] or ours["seconds"])
        context.checks.measured(
            context.device,
            f"{what}: time",
            alone,
            lambda ms: f"{ms:.3f} ms on the device alone, {1e3 * ours['seconds']:.2f} ms as called alone",
        )
        for name, least in (("flex", FLEX), ("gather", GATHER)):
            row = both.get(BASELINES[name], {"ratio": None, "error": "left out"})
            context.checks.measured(
                context.device,
                f"{what}: against {BASELINES[name]}",
                row["ratio"],
                lambda ratio: f"{ratio:.1f}× faster",
                bar=f"≥ {least:g}× faster",
                good=partial(_at_least, least),
                why=row["error"],
            )
        context.checks.measured(
            context.device,
            f"{what}: against the bytes to move",
            ours["times_bound"],
            lambda times: (
                f"{times:.1f}× ({case.least_bytes(JOBS[1]) / 1e6:.0f} MB at {bandwidth / 1e12:.2f} TB/s)"
            ),
            bar=f"≤ {BOUND:g}× their time",
            good=partial(_at_most, BOUND),
        )


def attention_memory(context: Context) -> None:
    """Take the memory of attention beyond inputs and outputs, with as many frames as are predicted from."""
    views, bar = context.sizes.many_views, f"≤ {ATTENTION_MB:g} MB"
    for direction in DIRECTIONS:
        name = f"attention {direction.replace('_', ' ')}, {views} frames: memory beyond inputs and outputs"
        with context.checks.attempt(name, bar):
            case = _case(context, direction, views)
            runs = {"all": partial(train, case.ours(), case.tensors, case.gradient)}
            taken = _unless_failed(measure(runs, 1, context.device)["all"])
            extra = None if taken.extra is None else taken.extra / 1e6
            context.checks.measured(
                context.device,
                name,
                extra,
                lambda mb: f"{mb:.1f} MB",
                bar=bar,
                good=partial(_at_most, ATTENTION_MB),
            )


def training_step(context: Context) -> None:
    """Take peak and time of a training step of stage 2, from an empty device on."""
    sizes, device = context.sizes, context.device
    name = f"training step of stage 2, {sizes.views} frames"
    with context.checks.attempt(name):
        cfg = step_config(sizes.preset, "stage2", device, sizes.settings)
        height, width = cfg.views.image_size
        cameras = walk(sizes.views).scaled_to((height, width))
        steps = run_steps(cfg, cameras, device, timed=sizes.steps, warm_up=sizes.warm_up)
        context.checks.measured(
            device,
            f"{name}: peak with weights, gradients and moments",
            steps.peak / 1e9,
            lambda gb: f"{gb:.2f} GB in {steps.precision}",
            bar=f"≤ {STEP_GB:g} GB",
            good=partial(_at_most, STEP_GB),
        )
        context.checks.measured(
            device,
            f"{name}: time",
            1e3 * steps.seconds,
            lambda ms: f"{ms:.1f} ms, {1e3 / ms:.1f} steps/s",
            bar=f"aimed at on an H200: {STEP_MS:g} ms",
        )
        _forecast(context, name, forecast_bytes(cfg, cameras, device, steps.precision), steps.peak)


def prediction(context: Context) -> None:
    """Take peak and time of a prediction from many frames, from an empty device on."""
    sizes, device = context.sizes, context.device
    name = f"prediction from {sizes.many_views} frames, {AT_ONCE} at once"
    with context.checks.attempt(name):
        settings = list(sizes.settings)
        row = predict_once(sizes.preset, settings, walk(sizes.many_views), AT_ONCE, device)
        peak, forecast = float(row["peak_mib"]) * MEBIBYTE, float(row["forecast_mib"]) * MEBIBYTE
        context.checks.measured(
            device,
            f"{name}: peak with weights",
            peak / 1e9,
            lambda gb: f"{gb:.2f} GB",
            bar=f"≤ {PREDICTION_GB:g} GB",
            good=partial(_at_most, PREDICTION_GB),
        )
        context.checks.measured(device, f"{name}: time", float(row["seconds"]), lambda s: f"{s:.2f} s")
        _forecast(context, name, forecast, peak)


def several_gpus(context: Context) -> None:
    """Take the time of a step on all GPUs together."""
    count, name = torch.cuda.device_count(), "training step of stage 2 on several GPUs"
    if count < 2:
        context.checks.add(name, why="there are not two GPUs")
        return
    with context.checks.attempt(name):
        found = context.output / "several_gpus.json"
        found.unlink(missing_ok=True)
        script = Path(__file__).resolve().parents[1] / "step.py"
        settings = ["trainer=ddp", f"trainer.devices={count}", *context.sizes.settings]
        command = [sys.executable, str(script), "--whole", "--preset", context.sizes.preset]
        done = subprocess.run([*command, "--json", str(found), *settings], check=False)
        if done.returncode or not found.is_file():
            raise RuntimeError(f"step.py ended with code {done.returncode}")
        steps = json.loads(found.read_text(encoding="utf-8"))
        took, waits = steps["seconds"], len(steps["waits"])
        told = f"{1e3 * took:.1f} ms, {count / took:.1f} scenes/s, {waits} waits"
        context.checks.add(f"training step of stage 2 on {count} GPUs", measured=told)


def boxes(context: Context) -> None:
    """Time the exact IoU of boxes against a sort on the CPU, and compare the GPU with the CPU."""
    torch.manual_seed(0)
    scenes = {"room 64×30": box_iou.room(64, 30), "dense 64×30": (box_iou.dense(64), box_iou.dense(30))}
    scenes["room 256×100"] = box_iou.room(256, 100)
    numbers, threads = torch.rand(1_000_000, dtype=torch.float64), torch.get_num_threads()
    torch.set_num_threads(1)
    candidates = {name: partial(exact_iou, *pair) for name, pair in scenes.items()}
    with context.checks.attempt("exact box IoU"), torch.no_grad():
        rounds = 2 * context.sizes.rounds
        seconds = median_seconds(candidates | {"sort": numbers.sort}, rounds, clock=time.process_time)
        for name, limit in box_iou.LIMITS.items():
            share = seconds[name] / seconds["sort"]
            # A processor's bar: judged wherever it is measured often enough.
            passed = None if context.device.why_unmeasured else share <= limit
            told = f"{share:.3f} of sorting 10⁶ float64, {1e3 * seconds[name]:.1f} ms"
            context.checks.add(f"exact box IoU, {name}", bar=f"≤ {limit:.2f}", measured=told, passed=passed)
    torch.set_num_threads(threads)
    name, bar = "exact box IoU, the device against the CPU", "within 1e-12"
    with context.checks.attempt(name, bar), torch.no_grad():
        worst = 0.0
        for pair in scenes.values():
            moved = [
                OrientedBoxes(*(t.to(context.device.torch_device) for t in (b.center, b.size, b.rotation)))
                for b in pair
            ]
            worst = max(worst, float((exact_iou(*moved)[0].cpu() - exact_iou(*pair)[0]).abs().max()))
        context.checks.add(name, bar=bar, measured=f"{worst:.1e}", passed=worst <= 1e-12)


def _forecast(context: Context, name: str, forecast: float, peak: float) -> None:
    context.checks.measured(
        context.device,
        f"{name}: raytran.plan's forecast of the peak",
        forecast / peak - 1,
        lambda off: f"{forecast / 1e9:.2f} GB for {peak / 1e9:.2f} GB, {off:+.0%}",
        bar=f"within {FORECAST:.0%}",
        good=lambda off: abs(off) <= FORECAST,
    )


def _case(context: Context, direction: Direction, views: int) -> Case:
    sizes = context.sizes
    cameras = _on(walk(views), context.device)
    grid = paper_grid(cameras, sizes.grid)
    return Case(cameras, grid, direction, torch.bfloat16, context.device, sizes.feature_size, sizes.heads)


def _on(cameras: Cameras, device: Device) -> Cameras:
    pose = cameras.world_from_camera.to(device.torch_device)
    return Cameras(cameras.intrinsics.to(device.torch_device), pose, cameras.image_size)


def _unless_failed(taken: Taken) -> Taken:
    if taken.error:
        raise RuntimeError(taken.error)
    return taken


def _other_gpu(device: Device) -> str:
    """Say that this is not the GPU that a time is asked of; "" where it is."""
    if device.why_unmeasured or "H200" in torch.cuda.get_device_name(device.torch_device):
        return ""
    return f" on a {torch.cuda.get_device_name(device.torch_device)}, for which there is no bar"


def _at_least(least: float, value: float) -> bool:
    return value >= least


def _at_most(most: float, value: float) -> bool:
    return value <= most


DIRECTIONS: tuple[Direction, ...] = ("voxels_to_pixels", "pixels_to_voxels")
