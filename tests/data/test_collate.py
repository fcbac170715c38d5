# SPDX-License-Identifier: Apache-2.0
"""Joining scenes along the batch."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from raytran.data.collate import collate_scenes
from raytran.errors import ShapeError
from raytran.structs import ObjectSet, SceneBatch, Views


def sample(name: str, value: float, num_views: int = 2, targets: bool = True) -> SceneBatch:
    return SceneBatch(
        scene_id=(name,),
        views=Views(
            images=torch.full((1, num_views, 3, 4, 6), int(value), dtype=torch.uint8),
            intrinsics=torch.full((1, num_views, 3, 3), value),
            world_from_camera=torch.full((1, num_views, 4, 4), value),
        ),
        frame_id=(tuple(f"{name}{i}" for i in range(num_views)),),
        grid_center=torch.full((1, 3), value),
        objects=(ObjectSet.empty(),) if targets else None,
        occupancy=torch.full((1, 2, 2, 2), value > 1) if targets else None,
        foreground=torch.full((1, num_views, 4, 6), value > 1) if targets else None,
    )


def test_scenes_are_joined_in_order() -> None:
    batch = collate_scenes([sample("a", 1.0), sample("b", 2.0)])
    assert batch.scene_id == ("a", "b")
    assert batch.frame_id == (("a0", "a1"), ("b0", "b1"))
    assert batch.views.images.shape == (2, 2, 3, 4, 6)
    assert batch.views.images.dtype == torch.uint8
    for part in (batch.views.intrinsics, batch.views.world_from_camera, batch.grid_center):
        assert [float(scene.unique()) for scene in part] == [1.0, 2.0]
    assert len(batch.objects) == 2
    assert [bool(scene.all()) for scene in batch.occupancy] == [False, True]
    assert [bool(scene.all()) for scene in batch.foreground] == [False, True]


def test_targets_that_were_not_asked_for_stay_none() -> None:
    batch = collate_scenes([sample("a", 1.0, targets=False), sample("b", 2.0, targets=False)])
    assert batch.objects is None
    assert batch.occupancy is None
    assert batch.foreground is None


def test_scenes_with_unequal_views_cannot_be_joined() -> None:
    with pytest.raises(ShapeError, match="one number and size"):
        collate_scenes([sample("a", 1.0), sample("b", 2.0, num_views=3)])


def test_pictures_are_joined_with_those_that_fill_their_images() -> None:
    first, second = sample("a", 1.0), sample("b", 2.0)
    assert collate_scenes([first, second]).views.picture is None
    picture = torch.tensor([[[1.0, 0.0, 3.0, 4.0], [0.0, 0.0, 6.0, 4.0]]])
    first = replace(first, views=replace(first.views, picture=picture))
    joined = collate_scenes([first, second]).views
    assert torch.equal(joined.picture, torch.cat([picture, picture[:, 1:].expand(1, 2, 4)]))
    assert torch.equal(joined.scene(0).picture, picture[0])
    assert torch.equal(joined.select(slice(0, 1)).picture[0], picture[0, :1])
