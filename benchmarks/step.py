# SPDX-License-Identifier: Apache-2.0
"""Each part of a training step: what it must cost, what it costs, and the gap: ``python benchmarks/step.py``.

The floor of a part is the higher of two times: its operations at the speed of a large matrix product, its
least bytes at the speed of a large copy, both measured first. Losses and optimiser count in the whole step.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import torch
from camera_path import add_arguments, cameras_of
from hydra.utils import instantiate
from record import write_rows
from timing import median_seconds, peak_mebibytes, print_machine
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.model import RayTran
from raytran.ops.fused import listed
from raytran.run.build import build_model
from raytran.run.ceilings import Ceilings, measure_ceilings
from raytran.run.entry import compose
from raytran.run.forecast import Load, work_of_parts
from raytran.run.step_parts import Part, step_parts
from raytran.types import ObjectSet, SceneBatch, Views

Clock = Callable[[], float] | None
"""Seconds; None is the wall clock, which waits for a GPU."""


def main() -> None:
    """Measure and print the parts, slowest first, and the whole step."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, rounds=5)
    parser.add_argument("--preset", default="raytran", choices=("raytran", "small", "tiny"))
    parser.add_argument("--views", type=int, help="frames of a scene; the preset's without it")
    parser.add_argument("--whole", action="store_true", help="the whole step alone")
    parser.add_argument("--count", action="store_true", help="measure nothing but the ceilings")
    parser.add_argument(
        "--ceilings", type=float, nargs=2, metavar=("TFLOP/S", "GB/S"), help="of another machine, for --count"
    )
    parser.add_argument(
        "--cpu-time", action="store_true", help="this process's own time, one thread: for a busy machine"
    )
    parser.add_argument("settings", nargs="*", help="more settings of conf/train.yaml, key=value")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    clock = time.process_time if arguments.cpu_time else None
    if arguments.cpu_time:
        torch.set_num_threads(1)
    settings = [f"preset={arguments.preset}", "experiment=stage2", "output_dir=unused", *arguments.settings]
    cfg = compose("train", [*settings, "model.backbone.resnet.weights=null"])
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model = build_model(cfg).to(device).train()
    count, size = arguments.views or cfg.views.num_views, tuple(cfg.views.image_size)
    cameras = cameras_of(arguments, count).scaled_to(size)
    batch = random_batch(cameras, model, cfg.views.batch_size).to(device)
    print_machine()
    rows = []
    if not arguments.whole:
        ceilings = measure_ceilings(device, _dtype(device), clock or time.perf_counter)
        if arguments.ceilings:
            ceilings = Ceilings(1e12 * arguments.ceilings[0], 1e9 * arguments.ceilings[1])
        rows, parts = count_parts(model, batch.views, ceilings, half=bool(arguments.ceilings))
        if not arguments.count:
            measure_parts(rows, parts, arguments.rounds, device, clock)
        print_parts(rows)
    if not arguments.count:
        rows.append(measure_step(cfg, model, batch, arguments.rounds, device, clock))
    if arguments.output:
        about = {"preset": arguments.preset, "views": count, "settings": " ".join(arguments.settings)}
        about["clock"] = "process" if arguments.cpu_time else "wall"
        write_rows(arguments.output / f"step-{arguments.preset}.csv", [about | row for row in rows])


def random_batch(cameras: Cameras, model: RayTran, scenes: int) -> SceneBatch:
    """Return ``scenes`` equal scenes of random images, ten objects each."""
    views = len(cameras.intrinsics)
    lead, size = (scenes, views), cameras.image_size
    images = torch.randint(0, 256, (*lead, model.backbone.resnet.input_channels, *size), dtype=torch.uint8)
    poses = (cameras.intrinsics.float(), cameras.world_from_camera.float())
    center = cameras.position.float().mean(dim=0)
    objects = ObjectSet(
        label=torch.randint(0, 9, (10,)),
        center=center + torch.randn(10, 3),
        size=torch.rand(10, 3) + 0.3,
        rotation=torch.eye(3).expand(10, 3, 3),
        symmetry=torch.ones(10, dtype=torch.int64),
        score=torch.ones(10),
    )
    return SceneBatch(
        tuple(f"scene{number}" for number in range(scenes)),
        Views(images, *(pose.expand(scenes, *pose.shape) for pose in poses)),
        ((),) * scenes,
        center.expand(scenes, 3),
        (objects,) * scenes,
        torch.rand(scenes, *model.grid_resolution) > 0.95,
        torch.rand(*lead, *size) > 0.7,
    )


def count_parts(
    model: RayTran, views: Views, ceilings: Ceilings, *, half: bool
) -> tuple[list[dict[str, Any]], list[Part]]:
    """Return what every part must cost, and the parts; ``half``: in 16 bit though this is a CPU."""
    device = views.images.device
    cameras = Cameras(views.intrinsics, views.world_from_camera, views.image_size)
    grid = VoxelGrid(model.grid_resolution, model.grid_extent, cameras.position.mean(dim=1))
    stride = model.backbone.stride
    size = (views.image_size[0] // stride, views.image_size[1] // stride)
    pairs = model.ray_tracer(cameras, grid, size, model.rays_per_cell)
    count = len(listed(pairs))
    tera, giga = ceilings.operations_per_second / 1e12, ceilings.bytes_per_second / 1e9
    print(f"ceilings: {tera:.3g} TFLOP/s, {giga:.4g} GB/s; {count:,} pairs")
    load = Load(*views.images.shape[:2], views.image_size, count / pairs.num_pixels, device.type == "cuda")
    precision = "16-mixed" if half or device.type == "cuda" else "32-true"
    work = work_of_parts(model, load, training=True, precision=precision)
    parts = step_parts(model, views, pairs)
    rows = [
        {
            "part": part.name,
            "times": part.times,
            "operations": work[part.name].operations,
            "least_bytes": work[part.name].bytes,
            "operations_per_second": ceilings.operations_per_second,
            "bytes_per_second": ceilings.bytes_per_second,
            "floor_s": work[part.name].seconds(ceilings.operations_per_second, ceilings.bytes_per_second),
        }
        for part in parts
    ]
    return rows, parts


def measure_parts(
    rows: list[dict[str, Any]], parts: list[Part], rounds: int, device: torch.device, clock: Clock
) -> None:
    """Enter into each row what its part takes."""
    runs = {part.name: partial(train_part, part, device) for part in parts}
    peaks = {name: peak_mebibytes(run) for name, run in runs.items()}
    seconds = median_seconds(runs, rounds, clock)
    for row, part in zip(rows, parts, strict=True):
        row |= {"seconds": part.times * seconds[part.name], "peak_mib": peaks[part.name]}


def print_parts(rows: list[dict[str, Any]]) -> None:
    """Print the parts, those that take longest first."""
    for row in sorted(rows, key=lambda row: -row.get("seconds", row["floor_s"])):
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


def train_part(part: Part, device: torch.device) -> None:
    """Run a part forward and backward."""
    with _autocast(device):
        out = part.run()
    if isinstance(out, Tensor):
        out.backward(torch.ones_like(out))


def measure_step(
    cfg: Any, model: RayTran, batch: SceneBatch, rounds: int, device: torch.device, clock: Clock
) -> dict[str, Any]:
    """Return and print time and memory of the whole step of stage 2, optimiser included."""
    stage, loss = instantiate(cfg.stage, _convert_="all"), instantiate(cfg.loss, _convert_="all")
    stage.freeze(model)
    for parameter in model.parameters():
        parameter.grad = None
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=1e-4)
    scaler = torch.amp.GradScaler(device.type, enabled=device.type == "cuda")

    def step() -> None:
        with _autocast(device):
            raw = model(batch.views, tasks=stage.tasks, grid_center=batch.grid_center)
            terms = loss(raw, batch, terms=stage.terms, decode_shapes=model.decode_shapes)
        optimizer.zero_grad()
        scaler.scale(terms["total"]).backward()
        scaler.unscale_(optimizer)
        torch.nn.utils.clip_grad_norm_(trained, 0.1)
        scaler.step(optimizer)
        scaler.update()

    step()
    seconds, peak = median_seconds({"step": step}, rounds, clock)["step"], peak_mebibytes(step)
    print(
        f"{'whole step':32s} {1e3 * seconds:10.1f} ms, {1 / seconds:.2f} steps/s, {peak:.0f} MiB over weights"
    )
    return {"part": "whole step", "times": 1, "seconds": seconds, "peak_mib": peak}


def _dtype(device: torch.device) -> torch.dtype:
    return torch.float16 if device.type == "cuda" else torch.float32


def _autocast(device: torch.device) -> AbstractContextManager[None]:
    return torch.autocast(device.type, dtype=torch.float16, enabled=device.type == "cuda")


if __name__ == "__main__":
    main()
