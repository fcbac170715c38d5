# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from raytran.backbone.resnet import ResNet18
from raytran.errors import ConfigError
from raytran.extensions.unprojection import UnprojectionBackbone, pair_centers
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList

from ..factories import run_backbone


def make_backbone(num_levels: int = 3) -> UnprojectionBackbone:
    torch.manual_seed(0)
    return UnprojectionBackbone(
        encoder=ResNet18(width=8), channels=8, num_blocks=1, num_levels=num_levels
    ).eval()


def scene(generator: torch.Generator, scenes: int = 1, views: int = 5) -> dict[str, Any]:
    """Cameras that look along +y through a grid of which they see a part."""
    pose = torch.eye(4).repeat(scenes, views, 1, 1)
    pose[..., :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[..., :3, 3] = torch.rand(scenes, views, 3, generator=generator) - torch.tensor([0.5, 1.5, 0.5])
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(scenes, views, 3, 3)
    return {
        "images": torch.rand(scenes, views, 3, 32, 48, generator=generator),
        "cameras": Cameras(intrinsics, pose, (32, 48)),
        "grid": VoxelGrid((5, 6, 4), (5.0, 6.0, 3.0), torch.zeros(scenes, 3)),
    }


def run(backbone: UnprojectionBackbone, inputs: dict[str, Any], **settings: Any) -> Any:
    def trace(cameras: Cameras) -> PairList:
        return pair_centers(cameras, inputs["grid"], (2, 3))

    return run_backbone(backbone, **inputs, trace=trace, **settings)


def sampled_mean(features: Tensor, cameras: Cameras, grid: VoxelGrid) -> Tensor:
    """Return the mean over the views of the nearest feature under each voxel's centre, by torch's sampler."""
    centers = grid.voxel_centers()[0].reshape(-1, 3)
    pixels, depth = Cameras(cameras.intrinsics[0], cameras.world_from_camera[0], cameras.image_size).project(
        centers
    )
    place = 2 * pixels / torch.tensor([48.0, 32.0]) - 1
    seen = (depth > 0) & (place.abs() < 1).all(dim=-1)
    images = features.movedim(-1, 1)
    found = F.grid_sample(images, place[:, None], mode="nearest", align_corners=False)[:, :, 0].movedim(1, -1)
    return (found * seen[..., None]).sum(dim=0) / seen.sum(dim=0).clamp(min=1)[:, None]


def test_voxels_start_as_the_mean_under_their_centres(generator: torch.Generator) -> None:
    backbone, inputs, start = make_backbone(), scene(generator), {}
    backbone.voxel_network.register_forward_pre_hook(lambda _, args: start.update(voxels=args[0]))
    with torch.no_grad():
        features = backbone.image_features(inputs["images"])
        run(backbone, inputs)
        expected = sampled_mean(features, inputs["cameras"], inputs["grid"])
    torch.testing.assert_close(start["voxels"].reshape(-1, 8), expected, rtol=1e-4, atol=1e-6)
    unseen = expected.abs().sum(dim=1) == 0
    assert 0 < int(unseen.sum()) < len(expected)


@pytest.mark.parametrize(("scenes", "views", "views_at_once"), [(1, 5, 2), (2, 3, 1)])
def test_chunks_give_what_all_views_give(
    scenes: int, views: int, views_at_once: int, generator: torch.Generator
) -> None:
    backbone, inputs = make_backbone(), scene(generator, scenes, views)
    with torch.no_grad():
        voxels, pixels = run(backbone, inputs)
        chunked = run(backbone, inputs, views_at_once=views_at_once)
    assert voxels.shape == (scenes, 5, 6, 4, 8)
    assert voxels.flatten(1, 3).std(dim=1).min() > 0.1
    torch.testing.assert_close(chunked[0], voxels, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(chunked[1], pixels, rtol=1e-5, atol=1e-5)


def test_pixels_are_those_of_each_view_alone(generator: torch.Generator) -> None:
    backbone, inputs = make_backbone(), scene(generator)
    other = inputs["images"].clone()
    other[:, 1] = 1 - other[:, 1]
    with torch.no_grad():
        voxels, pixels = run(backbone, inputs)
        new_voxels, new_pixels = run(backbone, {**inputs, "images": other})
    assert not torch.allclose(voxels, new_voxels)
    assert not torch.allclose(pixels[:, 1], new_pixels[:, 1])
    torch.testing.assert_close(new_pixels[:, [0, 2, 3, 4]], pixels[:, [0, 2, 3, 4]])


@pytest.mark.parametrize("with_pixels", [True, False])
def test_gradients_reach_all_that_is_not_idle(generator: torch.Generator, with_pixels: bool) -> None:
    backbone, inputs = make_backbone().train(), scene(generator)
    voxels, pixels = run(backbone, inputs, with_pixels=with_pixels)
    # Squares of what a layer normalisation returns add up to the same whatever comes in.
    (voxels**3).sum().backward() if pixels is None else ((voxels**3).sum() + (pixels**3).sum()).backward()
    without = {name for name, parameter in backbone.named_parameters() if parameter.grad is None}
    idle = backbone.idle_modules(with_pixels=with_pixels)
    assert without == {name for name, _ in backbone.named_parameters() if name.startswith(idle or ("-",))}
    for name, parameter in backbone.named_parameters():
        assert name in without or parameter.grad.abs().max() > 0, name


def test_norms_over_the_voxels_remember_as_they_are_told(generator: torch.Generator) -> None:
    network = UnprojectionBackbone(encoder=ResNet18(width=8), channels=8, num_blocks=1, norm_momentum=0.25)
    norm = network.voxel_network.down[0][0].bn1
    voxels = torch.rand(1, 6, 6, 6, 8, generator=generator)
    convolved = network.voxel_network.down[0][0].conv1(voxels.movedim(-1, 1))
    network.train().voxel_network(voxels)
    torch.testing.assert_close(norm.running_mean, 0.25 * convolved.mean(dim=(0, 2, 3, 4)))
    assert network.encoder.bn1.momentum == 0.1, "the image encoder has its own"


@pytest.mark.parametrize("wrong", [{"num_blocks": 0}, {"num_levels": 0}])
def test_nothing_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match="num_blocks and num_levels of at least 1"):
        UnprojectionBackbone(encoder=ResNet18(width=8), channels=8, **wrong)
