# SPDX-License-Identifier: Apache-2.0
"""A chair and a table, predicted, and boxes as their meshes."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
import trimesh

from raytran.geometry.camera import Cameras
from raytran.structs import ObjectSet, ScenePrediction

# world_from_object of an upright object turned by 30 degrees: width along (cos 30, sin 30, 0), up along z.
COS, SIN = math.sqrt(3) / 2, 0.5
TURNED = [[COS, 0.0, SIN], [SIN, 0.0, -COS], [0.0, 1.0, 0.0]]


@pytest.fixture
def turned() -> list[list[float]]:
    return TURNED


@pytest.fixture
def prediction() -> ScenePrediction:
    objects = ObjectSet(
        label=torch.tensor([3, 6]),
        center=torch.tensor([[1.0, 2.0, 0.5], [-1.0, 0.0, 0.375]]),
        size=torch.tensor([[0.5, 1.0, 0.6], [1.6, 0.75, 0.8]]),
        rotation=torch.tensor([TURNED, TURNED]),
        symmetry=torch.ones(2, dtype=torch.int64),
        score=torch.tensor([0.75, 0.5]),
        model_id=("03001627/abc", ""),
    )
    return ScenePrediction("scene0000_00", objects, torch.zeros(3))


@pytest.fixture
def box_at() -> Callable[[list[float]], trimesh.Trimesh]:
    def make(center: list[float]) -> trimesh.Trimesh:
        place = trimesh.transformations.translation_matrix(center)
        return trimesh.creation.box(extents=(0.5, 0.6, 1.0), transform=place)

    return make


@pytest.fixture
def cameras() -> Cameras:
    """Two cameras 1.5 m above the floor that look along +y."""
    pose = torch.eye(4)[None].repeat(2, 1, 1)
    pose[:, :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[:, :3, 3] = torch.tensor([[0.0, -3, 1.5], [0.25, -3, 1.5]])
    intrinsics = torch.tensor([[100.0, 0, 80], [0, 120, 60], [0, 0, 1]]).expand(2, 3, 3)
    return Cameras(intrinsics, pose, (120, 160))
