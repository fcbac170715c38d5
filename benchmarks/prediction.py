# SPDX-License-Identifier: Apache-2.0
"""Prediction in chunks of views, and the planner's forecast of it: ``python benchmarks/prediction.py``.

Each size runs in a process of its own, so that no peak hides in memory that an earlier one left behind.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import torch
from camera_path import add_arguments, cameras_of
from record import write_rows
from timing import peak_mebibytes, print_machine

from raytran.geometry.grid import VoxelGrid
from raytran.run.build import build_model
from raytran.run.entry import compose
from raytran.run.forecast import Load, prediction_bytes
from raytran.run.plan import FIXED, SCRATCH
from raytran.types import Views


def measure(arguments: argparse.Namespace, views: int, views_at_once: int | None) -> dict[str, object]:
    """Predict once from random images; return peak and time."""
    settings = [f"preset={arguments.preset}", "output_dir=unused", *arguments.settings]
    cfg = compose("train", [*settings, "model.backbone.resnet.weights=null"])
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model, size = build_model(cfg).eval(), tuple(cfg.views.image_size)
    cameras = cameras_of(arguments, views).scaled_to(size)
    grid = VoxelGrid(model.grid_resolution, model.grid_extent, cameras.position.mean(dim=0))
    few = cameras_of(arguments, 8).scaled_to(size)
    traced = model.ray_tracer(few, grid, (size[0] // 16, size[1] // 16), model.rays_per_cell)
    per_pixel = len(traced) / traced.num_pixels
    load = Load(1, views, size, per_pixel, fused=device.type == "cuda")
    forecast = prediction_bytes(model, load, views_at_once=views_at_once)
    images = torch.randint(0, 256, (1, views, 3, *size), dtype=torch.uint8)
    lead = (cameras.intrinsics[None].float(), cameras.world_from_camera[None].float())
    model.to(device)
    seen = Views(images, *lead).to(device)
    weights = sum(4 * parameter.numel() for parameter in model.parameters()) + images.numel()
    began = time.perf_counter()
    peak = peak_mebibytes(lambda: model.predict(seen, views_at_once=views_at_once)) + weights / 2**20
    return {
        "preset": arguments.preset,
        "views": views,
        "voxels": grid.num_voxels,
        "views_at_once": views_at_once or "all",
        "peak_mib": peak,
        "forecast_mib": (SCRATCH * forecast + FIXED) / 2**20,
        "seconds": time.perf_counter() - began,
    }


def main() -> None:
    """Measure all sizes, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, rounds=1)
    parser.add_argument("--preset", default="raytran")
    parser.add_argument("--views", type=int, nargs="+", default=[20, 96])
    parser.add_argument("--views-at-once", nargs="+", default=["all", "16"])
    parser.add_argument("--only", help=argparse.SUPPRESS)
    parser.add_argument("settings", nargs="*", help="more settings of conf/train.yaml, key=value")
    arguments = parser.parse_args()
    if arguments.only:
        views, at_once = json.loads(arguments.only)
        print(json.dumps(measure(arguments, views, at_once)))
        return
    print_machine()
    rows = []
    for views in arguments.views:
        for at_once in arguments.views_at_once:
            case = json.dumps([views, None if at_once == "all" else int(at_once)])
            done = subprocess.run(
                [sys.executable, str(Path(__file__)), *sys.argv[1:], f"--only={case}"],
                stdout=subprocess.PIPE,
                text=True,
                check=True,
            )
            row = json.loads(done.stdout.splitlines()[-1])
            rows.append(row)
            print(
                f"{views:4d} views, {at_once:>4s} at once: {row['peak_mib']:7.0f} MiB "
                f"(forecast {row['forecast_mib']:.0f}), {row['seconds']:.1f} s"
            )
    if arguments.output:
        most = max(arguments.views)
        write_rows(arguments.output / f"prediction-{arguments.preset}-{most}.csv", rows)


if __name__ == "__main__":
    main()
