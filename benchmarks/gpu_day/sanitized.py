# SPDX-License-Identifier: Apache-2.0
"""The kernels once at small sizes, to be run under compute-sanitizer."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from camera_path import paper_grid

from raytran.geometry.camera import Cameras
from raytran.ops.ray_attention import ray_attention
from raytran.ops.splat import splat_features
from raytran.ops.traverse import RayTracer
from raytran.run.plan.camera_paths import walk


def main(device: str = "cuda") -> None:
    """Trace, splat and attend in both directions, forward and backward, at sizes that fill no tile."""
    found = walk(3)
    cameras = Cameras(found.intrinsics.to(device), found.world_from_camera.to(device), found.image_size)
    pairs = RayTracer("fused")(cameras, paper_grid(cameras, (7, 9, 5)), (5, 9), 2)
    pixels, voxels = pairs.num_pixels, pairs.num_voxels
    for dtype in (torch.float32, torch.bfloat16, torch.float16):
        for direction, targets, sources in (
            ("pixels_to_voxels", voxels, pixels),
            ("voxels_to_pixels", pixels, voxels),
        ):
            query, key, value = (
                torch.randn(n, 2, 32, device=device, dtype=dtype, requires_grad=True)
                for n in (targets, sources, sources)
            )
            ray_attention(query, key, value, pairs, direction).float().sum().backward()
        features = torch.randn(pixels, 64, device=device, dtype=dtype, requires_grad=True)
        splat_features(features, pairs)[0].float().sum().backward()
    print(f"{len(pairs)} block pairs, no exception")


if __name__ == "__main__":
    main()
