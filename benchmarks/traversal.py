# SPDX-License-Identifier: Apache-2.0
"""Time of the traversal at the paper's size: ``python benchmarks/traversal.py [--scan FOLDER]``."""

from __future__ import annotations

import argparse
from functools import partial

import torch
from camera_path import FEATURE_SIZE, add_arguments, cameras_of, paper_grid
from record import write_rows
from timing import median_seconds, peak_mebibytes, print_machine

from raytran.ops.fused import listed
from raytran.ops.pairs import PairList
from raytran.ops.ray_tracer import RayTracer


def main() -> None:
    """Measure tracing with one and with four rays a cell; on a CPU, sorting by voxel too."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, rounds=15)
    parser.add_argument("--views", type=int, nargs="+", default=[20])
    arguments = parser.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    print_machine()
    rows = []
    for views in arguments.views:
        cameras = cameras_of(arguments, views, device)
        grid = paper_grid(cameras)
        tracers = {
            f"{n}×{n} rays a cell": partial(RayTracer(), cameras, grid, FEATURE_SIZE, n) for n in (1, 2)
        }
        pairs = {name: listed(trace()) for name, trace in tracers.items()}
        found = pairs["2×2 rays a cell"]

        def sort_by_voxel(found: PairList = found) -> object:
            return PairList(found.pixel_index, found.voxel_index, found.num_pixels, found.num_voxels).by(
                "voxels"
            )

        candidates = (
            dict(tracers) if device.type == "cuda" else {**tracers, "sorting 2×2 by voxel": sort_by_voxel}
        )
        peaks = {name: peak_mebibytes(run) for name, run in candidates.items()}
        seconds = median_seconds(candidates, arguments.rounds)
        for name, taken in seconds.items():
            count, peak = len(pairs.get(name, found)), peaks[name]
            rows.append({"views": views, "what": name, "pairs": count, "seconds": taken, "peak_mib": peak})
            print(f"{views:4d} views  {name:24s} {count:11,} pairs {taken * 1e3:8.2f} ms  {peak:6.0f} MiB")
    if arguments.output:
        write_rows(arguments.output / "traversal.csv", rows)


if __name__ == "__main__":
    main()
