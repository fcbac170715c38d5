# SPDX-License-Identifier: Apache-2.0
"""Time of the traversal at the paper's size: ``python benchmarks/traversal.py [--scan FOLDER]``."""

from __future__ import annotations

import argparse
from functools import partial

from camera_path import FEATURE_SIZE, PAPER_GRID, add_arguments, cameras_of, paper_grid
from device import Device, this_device
from record import write_rows
from timing import MEBIBYTE, Run, measure, print_machine

from raytran.geometry.camera import Cameras
from raytran.ops.pairs import PairList, listed
from raytran.ops.traverse import RayTracer


def tracers(
    cameras: Cameras,
    device: Device,
    feature_size: tuple[int, int] = FEATURE_SIZE,
    resolution: tuple[int, int, int] = PAPER_GRID,
) -> dict[str, Run]:
    """Return tracing with one and with four rays a cell, both orders made."""
    grid = paper_grid(cameras, resolution)
    trace = RayTracer(device.attention)
    return {f"{n}×{n} rays a cell": partial(trace, cameras, grid, feature_size, n) for n in (1, 2)}


def main() -> None:
    """Measure tracing with one and with four rays a cell; on a CPU, sorting by voxel too."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, rounds=15)
    parser.add_argument("--views", type=int, nargs="+", default=[20])
    arguments = parser.parse_args()
    device = this_device()
    print_machine()
    rows = []
    for views in arguments.views:
        candidates = tracers(cameras_of(arguments, views, device.torch_device), device)
        counts: dict[str, int] = {}

        def count(name: str, trace: Run, counts: dict[str, int] = counts) -> object:
            pairs = trace()
            counts[name] = counts.get(name) or len(listed(pairs))
            return pairs

        runs: dict[str, Run] = {name: partial(count, name, trace) for name, trace in candidates.items()}
        if device.torch_device.type == "cpu":
            found = listed(candidates["2×2 rays a cell"]())
            runs["sorting 2×2 by voxel"] = partial(sort_by_voxel, found)
            counts["sorting 2×2 by voxel"] = len(found)
        for name, taken in measure(runs, arguments.rounds, device).items():
            row = {"views": views, "what": name, "pairs": counts.get(name), "seconds": taken.seconds}
            if taken.error:
                rows.append(row | {"error": taken.error})
                print(f"{views:4d} views  {name:24s} does not run here: {taken.error}")
                continue
            rows.append(row | {"peak_mib": taken.peak / MEBIBYTE})
            print(
                f"{views:4d} views  {name:24s} {counts[name]:11,} pairs {taken.seconds * 1e3:8.2f} ms"
                f"  {taken.peak / MEBIBYTE:6.0f} MiB"
            )
    if arguments.output:
        write_rows(arguments.output / "traversal.csv", rows)


def sort_by_voxel(pairs: PairList) -> object:
    """Bring a list, which has no order yet, into that of the voxels."""
    fresh = PairList(pairs.pixel_index, pairs.voxel_index, pairs.num_pixels, pairs.num_voxels)
    return fresh.by("voxels")


if __name__ == "__main__":
    main()
