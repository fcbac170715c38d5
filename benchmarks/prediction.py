# SPDX-License-Identifier: Apache-2.0
"""Prediction in chunks of views, and the planner's forecast of it: ``python benchmarks/prediction.py``.

Each size runs in a process of its own, so that no peak hides in memory that an earlier one left behind, and
none ends the others. The peak is that of everything on the device, weights and images included.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import torch
from camera_path import add_arguments, cameras_of
from device import Device, this_device
from record import write_rows
from step import load_of
from timing import MEBIBYTE, print_machine, reason

from raytran.geometry.camera import Cameras
from raytran.ops.traverse import RayTracer
from raytran.run.entry import compose
from raytran.run.plan.dry_run import dry_prediction
from raytran.run.plan.plan import FIXED, SCRATCH
from raytran.run.train.build import build_model
from raytran.structs import Views


def predict_once(
    preset: str,
    settings: list[str],
    cameras: Cameras,
    views_at_once: int | None,
    device: Device,
) -> dict[str, object]:
    """Predict from random images, once on a device that is empty before; return peak, forecast and time.

    The peak has weights and images in it. The time is that of a second prediction.
    """
    held = device.held()
    cfg = compose("train", [f"preset={preset}", "output_dir=unused", *settings])
    model, size = build_model(cfg, pretrained=False).eval(), tuple(cfg.views.image_size)
    cameras = cameras.scaled_to(size)
    views = len(cameras.intrinsics)
    forecast = dry_prediction(model, load_of(model, cameras, 1, device), views_at_once=views_at_once).peak
    images = torch.randint(0, 256, (1, views, 3, *size), dtype=torch.uint8)
    lead = (cameras.intrinsics[None].float(), cameras.world_from_camera[None].float())
    if device.torch_device.type == "cpu":
        held = device.held()  # the dry run of the forecast is over; the network and the images are added
        held -= sum(tensor.nbytes for tensor in (*model.parameters(), images))
    model.to(device.torch_device).ray_tracer = RayTracer(device.attention)
    seen = Views(images, *lead).to(device.torch_device)
    with device.counting():
        model.predict(seen, views_at_once=views_at_once)
        peak = device.peak() - held
        began = device.clock()
        model.predict(seen, views_at_once=views_at_once)
    x, y, z = model.grid_resolution
    return {
        "preset": preset,
        "views": views,
        "voxels": x * y * z,
        "views_at_once": views_at_once or "all",
        "peak_mib": peak / MEBIBYTE,
        "forecast_mib": (SCRATCH * forecast + FIXED) / MEBIBYTE,
        "seconds": device.clock() - began,
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
        cameras = cameras_of(arguments, views)
        try:
            row = predict_once(arguments.preset, arguments.settings, cameras, at_once, this_device())
        except Exception as error:  # whatever it is, it ends this size alone
            row = {"preset": arguments.preset, "views": views, "views_at_once": at_once or "all"}
            row |= {"error": reason(error)}
        print(json.dumps(row))
        return
    print_machine()
    rows = []
    for views in arguments.views:
        for at_once in arguments.views_at_once:
            case = json.dumps([views, None if at_once == "all" else int(at_once)])
            command = [sys.executable, str(Path(__file__)), *sys.argv[1:], f"--only={case}"]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
            if done.returncode:
                row = {"preset": arguments.preset, "views": views, "views_at_once": at_once}
                row |= {"error": f"the process ended with code {done.returncode}"}
            else:
                row = json.loads(done.stdout.splitlines()[-1])
            rows.append(row)
            print(f"{views:4d} views, {at_once:>4s} at once: {_in_words(row)}")
    if arguments.output:
        most = max(arguments.views)
        write_rows(arguments.output / f"prediction-{arguments.preset}-{most}.csv", rows)


def _in_words(row: dict[str, object]) -> str:
    if "error" in row:
        return f"does not run here: {row['error']}"
    return f"{row['peak_mib']:7.0f} MiB (forecast {row['forecast_mib']:.0f}), {row['seconds']:.1f} s"


if __name__ == "__main__":
    main()
