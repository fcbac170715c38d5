# SPDX-License-Identifier: Apache-2.0
"""Random pair lists and cameras for the tests of the operations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from raytran.geometry.camera import Cameras
from raytran.ops.pairs import PairList


@pytest.fixture
def random_pairs(generator: torch.Generator) -> Callable[[int, int, float], PairList]:
    """Make pairs at random; the first and the last pixel and voxel have none."""

    def make(num_pixels: int, num_voxels: int, density: float) -> PairList:
        joined = torch.rand(num_pixels, num_voxels, generator=generator) < density
        if num_pixels > 2 and num_voxels > 2:
            joined[[0, -1]] = False
            joined[:, [0, -1]] = False
        index = joined.nonzero()
        return PairList(index[:, 0], index[:, 1], num_pixels, num_voxels)

    return make


@pytest.fixture
def random_cameras(generator: torch.Generator) -> Callable[..., Cameras]:
    """Make cameras with any orientation, at normally distributed positions of a given spread in metres."""

    def make(*lead: int, spread: float) -> Cameras:
        rotation = torch.linalg.qr(torch.randn(*lead, 3, 3, generator=generator, dtype=torch.float64)).Q
        rotation = rotation * torch.linalg.det(rotation)[..., None, None]
        pose = torch.eye(4, dtype=torch.float64).repeat(*lead, 1, 1)
        pose[..., :3, :3] = rotation
        pose[..., :3, 3] = spread * torch.randn(*lead, 3, generator=generator, dtype=torch.float64)
        intrinsics = torch.tensor([[50.0, 0.0, 41.0], [0.0, 47.0, 29.0], [0.0, 0.0, 1.0]])
        return Cameras(intrinsics.double().expand(*lead, 3, 3), pose, (60, 80))

    return make


@pytest.fixture
def shaped_pairs(random_pairs: Callable[[int, int, float], PairList]) -> Callable[..., PairList]:
    """Make pairs at random between views ``(n, h, w)`` and grids ``(B, X, Y, Z)``; the ends have none."""

    def make(
        pixel_shape: tuple[int, int, int], voxel_shape: tuple[int, int, int, int], density: float
    ) -> PairList:
        plain = random_pairs(math.prod(pixel_shape), math.prod(voxel_shape), density)
        return replace(plain, pixel_shape=pixel_shape, voxel_shape=voxel_shape)

    return make
