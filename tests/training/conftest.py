# SPDX-License-Identifier: Apache-2.0
"""A network and a scene small enough to step in a moment."""

from __future__ import annotations

import pytest
import torch

from raytran.geometry.rotation import rotation_from_yaw
from raytran.run.entry import compose
from raytran.run.train.build import build_model, build_module
from raytran.structs import SHAPE_SIZE, ObjectSet, SceneBatch, Views

SMALL = [
    "preset=tiny",
    "model.grid_resolution=[8,8,4]",
    "model.heads.objects.num_queries=6",
    "output_dir=unused",
]


@pytest.fixture
def batch(generator):
    """One scene of two objects, seen by three cameras that look along +x; two more views to be rendered."""
    num_views, size = 3, (64, 64)
    poses = torch.eye(4).repeat(num_views, 1, 1)
    poses[:, :3, :3] = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    poses[:, 1, 3] = torch.tensor([-0.5, 0.0, 0.5])
    intrinsics = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 32.0], [0.0, 0.0, 1.0]])
    objects = ObjectSet(
        label=torch.tensor([3, 6]),
        center=torch.tensor([[1.5, 0.3, -0.4], [2.0, -0.6, -0.4]]),
        size=torch.tensor([[0.5, 0.9, 0.5], [1.2, 0.7, 0.8]]),
        rotation=rotation_from_yaw(torch.tensor([0.4, -1.0])),
        symmetry=torch.tensor([1, 2]),
        score=torch.ones(2),
        shape=torch.rand(2, SHAPE_SIZE, SHAPE_SIZE, SHAPE_SIZE, generator=generator) > 0.5,
    )
    return SceneBatch(
        scene_id=("scene0000_00",),
        views=Views(
            images=torch.randint(0, 256, (1, num_views, 3, *size), dtype=torch.uint8, generator=generator),
            intrinsics=intrinsics.repeat(1, num_views, 1, 1),
            world_from_camera=poses[None],
        ),
        frame_id=(("0", "1", "2"),),
        grid_center=torch.tensor([[1.5, 0.0, 0.0]]),
        objects=(objects,),
        occupancy=torch.rand(1, 8, 8, 4, generator=generator) > 0.8,
        foreground=torch.rand(1, num_views, *size, generator=generator) > 0.5,
        new_views=Views(
            images=torch.randint(0, 256, (1, 2, 3, *size), dtype=torch.uint8, generator=generator),
            intrinsics=intrinsics.repeat(1, 2, 1, 1),
            world_from_camera=poses[None, :2] + 0.1 * torch.eye(4)[:, 3:].roll(1, 0) @ torch.eye(4)[3:],
        ),
    )


@pytest.fixture
def make_module():
    """Return a function that builds the LightningModule of an experiment."""

    def make(experiment, *settings):
        torch.manual_seed(0)
        presets = {item.partition("=")[0] for item in settings} & {"preset"}
        small = [item for item in SMALL if item.partition("=")[0] not in presets]
        cfg = compose("train", [*small, f"experiment={experiment}", *settings])
        return build_module(cfg, build_model(cfg))

    return make
