# SPDX-License-Identifier: Apache-2.0
"""The paper's sizes, and the cameras to measure with: a made-up walk, or those of a recorded scan."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.run.plan.camera_paths import recorded, walk

FEATURE_SIZE = (30, 40)
PAPER_GRID = (48, 48, 16)


def paper_grid(cameras: Cameras, resolution: tuple[int, int, int] = PAPER_GRID) -> VoxelGrid:
    """Return the paper's volume, centred on the cameras."""
    return VoxelGrid(resolution, (9.0, 9.0, 3.5), cameras.position.mean(dim=-2))


def add_arguments(parser: argparse.ArgumentParser, *, rounds: int) -> None:
    """Add what all benchmarks can be told."""
    parser.add_argument("--scan", type=Path, help="a scan in ScanNet's layout; a made-up walk without it")
    parser.add_argument("--rounds", type=int, default=rounds)
    parser.add_argument("--output", type=Path, help="folder for CSV files")


def cameras_of(arguments: argparse.Namespace, views: int, device: torch.device | None = None) -> Cameras:
    """Return the cameras that the arguments ask for."""
    found = recorded(arguments.scan, views) if arguments.scan else walk(views)
    return Cameras(found.intrinsics.to(device), found.world_from_camera.to(device), found.image_size)
