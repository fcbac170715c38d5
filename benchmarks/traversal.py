# SPDX-License-Identifier: Apache-2.0
"""Time of the traversal at the paper's size: ``python benchmarks/traversal.py [--scan FOLDER]``."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from camera_path import FEATURE_SIZE, paper_grid, recorded, walk
from timing import median_seconds, peak_mebibytes, print_machine

from raytran.ops.pairs import PairList
from raytran.ops.traverse import trace_pairs


def main() -> None:
    """Measure tracing with one and with four rays a cell, and sorting by voxel."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scan", type=Path, help="a scan in ScanNet's layout; a made-up walk without it")
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=15)
    arguments = parser.parse_args()
    cameras = recorded(arguments.scan, arguments.views) if arguments.scan else walk(arguments.views)
    grid = paper_grid(cameras)
    print_machine()

    one_ray, four_rays = (partial(trace_pairs, cameras, grid, FEATURE_SIZE, n) for n in (1, 2))
    print(f"memory with 2×2 rays a cell, results included: {peak_mebibytes(four_rays):.0f} MiB")
    pairs = four_rays()
    print(f"{arguments.views} views: {len(one_ray()):,} pairs with one ray a cell, {len(pairs):,} with 2×2")

    def sort_by_voxel() -> object:
        return PairList(pairs.pixel_index, pairs.voxel_index, pairs.num_pixels, pairs.num_voxels).by("voxels")

    seconds = median_seconds(
        {
            "1 ray a cell": one_ray,
            "2×2 rays a cell": four_rays,
            "sorting 2×2 by voxel": sort_by_voxel,
        },
        arguments.rounds,
    )
    for name, taken in seconds.items():
        print(f"{name:24s} {taken * 1e3:8.1f} ms")


if __name__ == "__main__":
    main()
