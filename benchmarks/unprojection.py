# SPDX-License-Identifier: Apache-2.0
"""For scale, what others do instead of attention: ``python benchmarks/unprojection.py``.

ImVoxelNet (Rukhovich et al., WACV 2022) projects each voxel's centre into every view and averages the
features it falls on: one sample a voxel and view, no attention. Our first voxel features average along rays.
"""

from __future__ import annotations

import argparse
from functools import partial

import torch
import torch.nn.functional as F
from camera_path import FEATURE_SIZE, add_arguments, cameras_of, paper_grid
from device import this_device
from record import write_rows
from timing import MEBIBYTE, measure, print_machine
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.ray_attention import ray_attention
from raytran.ops.splat import splat_features
from raytran.ops.traverse import RayTracer

HEADS, CHANNELS = 8, 256


def unproject(features: Tensor, cameras: Cameras, grid: VoxelGrid) -> Tensor:
    """Return the mean of the nearest features under each voxel's centre, ``(N, h, w, C) -> (V, C)``."""
    centers = grid.voxel_centers().reshape(-1, 3).to(cameras.intrinsics.dtype)
    pixels, depth = cameras.project(centers)
    size = pixels.new_tensor([cameras.image_size[1], cameras.image_size[0]])
    place = (2 * pixels / size - 1).to(features.dtype)
    seen = (depth > 0) & (place.abs() < 1).all(dim=-1)
    total = features.new_zeros(len(centers), features.shape[-1])
    for view in range(len(features)):
        image = features[view].movedim(-1, 0)[None]
        sampled = F.grid_sample(image, place[view, None, None], mode="nearest", align_corners=False)
        total += sampled[0, :, 0].T * seen[view, :, None]
    return total / seen.sum(dim=0).clamp(min=1)[:, None]


def main() -> None:
    """Measure unprojection, splatting, and attention to the voxels."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, rounds=5)
    parser.add_argument("--views", type=int, nargs="+", default=[20])
    arguments = parser.parse_args()
    device = this_device()
    print_machine()
    rows = []
    for views in arguments.views:
        cameras = cameras_of(arguments, views, device.torch_device)
        grid = paper_grid(cameras)
        pairs = RayTracer()(cameras, grid, FEATURE_SIZE, 2)
        features = torch.randn(views, *FEATURE_SIZE, CHANNELS, device=device.torch_device)
        source = features.view(-1, HEADS, CHANNELS // HEADS)
        query = torch.randn(grid.num_voxels, *source.shape[1:], device=device.torch_device)
        candidates = {
            "mean unprojection (ImVoxelNet)": partial(unproject, features, cameras, grid),
            "splatting along rays": partial(splat_features, features.flatten(0, 2), pairs),
            "ray-traced attention": partial(ray_attention, query, source, source, pairs),
        }
        for name, taken in measure(candidates, arguments.rounds, device).items():
            row = {"views": views, "what": name, "seconds": taken.seconds}
            if taken.error:
                rows.append(row | {"error": taken.error})
                print(f"{views:4d} views  {name:32s} does not run here: {taken.error}")
                continue
            rows.append(row | {"peak_mib": taken.peak / MEBIBYTE})
            milliseconds, mebibytes = 1e3 * taken.seconds, taken.peak / MEBIBYTE
            print(f"{views:4d} views  {name:32s} {milliseconds:9.2f} ms  {mebibytes:7.0f} MiB")
    if arguments.output:
        write_rows(arguments.output / "unprojection.csv", rows)


if __name__ == "__main__":
    main()
