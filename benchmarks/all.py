# SPDX-License-Identifier: Apache-2.0
"""Everything that this machine can measure, as CSV and pictures: ``python benchmarks/all.py --output DIR``.

On a CPU the sizes are smaller (an hour on two cores; ``--quick`` five minutes). On a GPU it has never run: by
estimate a quarter of an hour on an H200. ``gpu_day.py`` is the command that checks a machine.
A benchmark that fails is said at the end and does not stop the others.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

import torch
from plots import draw_all

HERE = Path(__file__).parent


def main() -> None:
    """Run the benchmarks one after another, then draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True, help="folder for CSV files and pictures")
    parser.add_argument("--scan", type=Path, help="a scan in ScanNet's layout; a made-up walk without it")
    parser.add_argument("--quick", action="store_true", help="small sizes: does everything run?")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    extra = ["--output", str(arguments.output.resolve())]
    extra += ["--scan", str(arguments.scan.resolve())] if arguments.scan else []
    failed = []
    for command in commands(gpu=torch.cuda.is_available(), quick=arguments.quick):
        print(f"\n$ python benchmarks/{' '.join(command)}", flush=True)
        began = time.monotonic()
        done = subprocess.run([sys.executable, str(HERE / command[0]), *extra, *command[1:]], check=False)
        print(f"({time.monotonic() - began:.0f} s)")
        if done.returncode:
            failed.append(" ".join(command))
    draw_all(arguments.output)
    if failed:
        raise SystemExit("failed: " + "; ".join(failed))


def commands(*, gpu: bool, quick: bool) -> list[list[str]]:
    """Return the scripts to run and their arguments, those that matter most first."""
    views = ["2", "4"] if quick else ["20", "48", "96", "192", "384"] if gpu else ["20", "48", "96"]
    grids = ["12x12x4", "24x24x8"] if quick else ["24x24x8", "48x48x16", "96x96x32"]
    presets = ["tiny"] if quick else ["raytran", "small", "tiny"] if gpu else ["tiny", "raytran"]
    dtypes = ["float32", "bfloat16"] if gpu else ["float32"]
    baselines = ["gather", "dense", "flex"] if gpu else ["gather", "dense"]
    against = ["--baselines", *(name for name in baselines if name != "dense")]
    attention = ["ray_attention.py", "--dtype", *dtypes]
    one_size = ["--views", views[0], "--resolution", grids[0] if quick else grids[1]]
    return [
        [*attention, *one_size, "--baselines", *baselines, "--name", "attention"],
        ["traversal.py", "--views", *views],
        *(["step.py", "--preset", preset] for preset in presets),
        [*attention, "--views", *views, *one_size[2:], *against, "--name", "attention-views"],
        [
            *attention,
            "--views",
            views[0],
            "--resolution",
            *grids,
            "--baselines",
            "--name",
            "attention-voxels",
        ],
        ["unprojection.py", "--views", *views[:3]],
        *_predictions(gpu=gpu, quick=quick),
    ]


def _predictions(*, gpu: bool, quick: bool) -> list[list[str]]:
    if quick:
        return [["prediction.py", "--preset", "tiny", "--views", "12", "--views-at-once", "all", "4"]]
    if not gpu:
        return [["prediction.py", "--preset", "small", "--views", "24", "96", "--views-at-once", "all", "8"]]
    paper, large = ["--preset", "raytran", "--views-at-once"], "model.grid_resolution=[96,96,32]"
    return [
        ["prediction.py", *paper, "all", "16", "--views", "20", "96"],
        ["prediction.py", large, *paper, "16", "--views", "384"],
    ]


if __name__ == "__main__":
    main()
