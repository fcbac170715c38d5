# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import pytest
import torch

from raytran.extensions.box_refinement import BoxRefinement
from raytran.extensions.windowed_attention import WindowedAttention
from raytran.geometry.grid import VoxelGrid
from raytran.heads.decoder import VoxelAttention
from raytran.heads.objects import CenterRefinement, ObjectHead
from raytran.structs import RawObjects

EXTENT = (4.0, 4.0, 2.0)


def small_head(**changes: Any) -> ObjectHead:
    torch.manual_seed(0)
    sizes = {
        "channels": 24,
        "num_heads": 2,
        "num_layers": 2,
        "num_queries": 6,
        "hidden": 24,
        "voxel_attention": WindowedAttention,
        **changes,
    }
    return ObjectHead(**sizes, grid_extent=EXTENT)


def grid_at(*centers: list[float]) -> VoxelGrid:
    return VoxelGrid((4, 4, 2), EXTENT, torch.tensor(centers))


def last(head: ObjectHead, voxels: torch.Tensor, grid: VoxelGrid) -> RawObjects:
    """What the last layer predicts."""
    return head(voxels, grid).layers[-1]


def test_shapes_of_every_layer() -> None:
    outputs, proposals, _ = small_head()(torch.randn(2, 4, 4, 2, 24), grid_at([0.0, 0, 0], [1.0, 2, 3]))
    assert len(outputs) == 2
    assert proposals is None
    for objects in outputs:
        assert objects.class_logits.shape == (2, 6, 10)
        assert objects.center.shape == objects.log_size.shape == (2, 6, 3)
        assert objects.yaw_vector.shape == (2, 6, 2)
        assert objects.embedding.shape == (2, 6, 24)


@pytest.mark.parametrize("refinement", [CenterRefinement(), BoxRefinement()])
@pytest.mark.parametrize("attention", [VoxelAttention, WindowedAttention])
def test_later_layers_teach_earlier_ones_where_to_look(refinement, attention) -> None:
    """Reference points are refined with gradients: the last centre's reaches the first layer's offset."""
    head = small_head(refinement=refinement, voxel_attention=attention, num_layers=3)
    last(head, torch.randn(1, 4, 4, 2, 24), grid_at([0.0, 0, 0])).center.sum().backward()
    for predictor in head.predictors:
        # Offsets add up: a layer's bias moves all six queries' last centres along with its own.
        bias = predictor.offset[-1].bias.grad
        assert bias is not None
        assert bool((bias.abs() > 1).all())


def test_centers_move_with_the_grid() -> None:
    head, voxels = small_head(), torch.randn(1, 4, 4, 2, 24)
    here, there = last(head, voxels, grid_at([0.0, 0, 0])), last(head, voxels, grid_at([10.0, -20, 5]))
    torch.testing.assert_close(there.center - here.center, torch.tensor([10.0, -20, 5]).expand(1, 6, 3))
    torch.testing.assert_close(there.log_size, here.log_size)


def test_untrained_objects_lie_in_the_volume_with_common_sizes() -> None:
    objects = last(small_head(num_queries=32), torch.randn(1, 4, 4, 2, 24), grid_at([0.0, 0, 0]))
    assert bool((objects.center.abs() < torch.tensor(EXTENT) / 2).all())
    # One slot in each octant at least: no object is far from every slot.
    octant = (objects.center[0] > 0).long() @ torch.tensor([4, 2, 1])
    assert len(octant.unique()) == 8
    torch.testing.assert_close(objects.log_size.exp(), torch.full((1, 32, 3), 0.7), rtol=0.3, atol=0.0)


def test_every_parameter_gets_a_gradient() -> None:
    head = small_head()
    outputs = head(torch.randn(1, 4, 4, 2, 24), grid_at([0.0, 0, 0])).layers
    fields = ("class_logits", "center", "log_size", "yaw_vector")
    sum(getattr(objects, name).square().sum() for objects in outputs for name in fields).backward()
    assert [name for name, p in head.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_half_precision_keeps_centers_exact() -> None:
    """bfloat16 has steps of 16 mm at 4 m; centres must not be rounded to them."""
    head, voxels, grid = small_head(), torch.randn(1, 4, 4, 2, 24), grid_at([100.0, 0, 0])
    exact = last(head, voxels, grid)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = last(head, voxels, grid)
    assert half.center.dtype == half.class_logits.dtype == torch.float32
    assert float((half.center - exact.center).detach().abs().max()) < 0.02


@pytest.mark.parametrize("refinement", [CenterRefinement(), BoxRefinement()])
def test_layers_predict_the_change_of_what_is_refined(refinement) -> None:
    """The last layers of all predictors are set to a constant: what adds up grows from layer to layer."""
    head = small_head(num_layers=3, refinement=refinement)
    with torch.no_grad():
        for predictor in head.predictors:
            for network in (predictor.offset, predictor.log_size, predictor.yaw):
                network[-1].weight.zero_()
                network[-1].bias.fill_(0.1)
    first, _, third = head(torch.randn(1, 4, 4, 2, 24), grid_at([0.0, 0, 0])).layers
    torch.testing.assert_close(third.center - first.center, torch.full((1, 6, 3), 0.2))
    grown = 0.2 if isinstance(refinement, BoxRefinement) else 0.0
    torch.testing.assert_close(third.log_size - first.log_size, torch.full((1, 6, 3), grown))
    torch.testing.assert_close(third.yaw_vector - first.yaw_vector, torch.full((1, 6, 2), grown))


def test_refined_boxes_pass_gradients_to_early_layers() -> None:
    reached = []
    for refinement in (CenterRefinement(), BoxRefinement()):
        head = small_head(refinement=refinement)
        last(head, torch.randn(1, 4, 4, 2, 24), grid_at([0.0, 0, 0])).log_size.sum().backward()
        reached.append(head.predictors[0].log_size[-1].bias.grad is not None)
    assert reached == [False, True]
