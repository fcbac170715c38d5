# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import pytest
import torch

from raytran.backbone.backbone import Backbone
from raytran.backbone.resnet import ResNet18
from raytran.errors import ConfigError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList


def make_backbone(num_blocks: int = 1) -> Backbone:
    torch.manual_seed(0)
    return Backbone(resnet=ResNet18(width=4), channels=8, num_heads=2, num_blocks=num_blocks).eval()


def scene(center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    """Two views of 2×2 cells; pixel i sees voxel i of the first 8 of 12 voxels."""
    pose = torch.eye(4).repeat(1, 2, 1, 1)
    pose[..., :3, 3] = torch.tensor(center) + torch.tensor([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    intrinsics = torch.tensor([[20.0, 0, 16], [0, 20, 16], [0, 0, 1]]).expand(1, 2, 3, 3)
    return {
        "cameras": Cameras(intrinsics, pose, (32, 32)),
        "grid": VoxelGrid((2, 2, 3), (2.0, 2.0, 3.0), torch.tensor([center])),
        "pairs": PairList(torch.arange(8), torch.arange(8), 8, 12),
    }


def test_voxels_start_as_mean_features_or_unseen() -> None:
    backbone, start = make_backbone(), {}
    torch.nn.init.zeros_(backbone.voxel_position.weight)
    torch.nn.init.zeros_(backbone.voxel_position.bias)
    backbone.blocks[0].register_forward_pre_hook(
        lambda _, inputs: start.update(voxels=inputs[0], pixels=inputs[1])
    )
    backbone(torch.rand(1, 2, 3, 32, 32), **scene())
    voxels, pixels = start["voxels"].view(12, 8), start["pixels"].reshape(8, 8)
    torch.testing.assert_close(voxels[:8], pixels)
    torch.testing.assert_close(voxels[8:], backbone.unseen.expand(4, 8))


def test_images_are_normalised_as_imagenets() -> None:
    backbone, seen = make_backbone(), {}
    backbone.resnet.register_forward_pre_hook(lambda _, inputs: seen.update(images=inputs[0]))
    backbone(torch.full((1, 2, 3, 32, 32), 255, dtype=torch.uint8), **scene())
    # (1 - 0.485) / 0.229, (1 - 0.456) / 0.224, (1 - 0.406) / 0.225
    torch.testing.assert_close(seen["images"][0, :, 0, 0], torch.tensor([2.24890, 2.42857, 2.64000]))


def test_features_do_not_depend_on_where_the_world_has_its_origin() -> None:
    backbone, images = make_backbone(), torch.rand(1, 2, 3, 32, 32)
    here, there = backbone(images, **scene()), backbone(images, **scene((30.0, -8.0, 2.0)))
    torch.testing.assert_close(here[0], there[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(here[1], there[1], rtol=1e-4, atol=1e-5)


def test_pixels_know_their_rays() -> None:
    """The same two images from other camera positions in the grid give other pixel features."""
    backbone, images = make_backbone(), torch.rand(1, 2, 3, 32, 32)
    here, there = scene(), scene((0.0, 0.0, 0.7))
    assert not torch.allclose(
        backbone(images, **here)[1], backbone(images, **{**here, "cameras": there["cameras"]})[1], atol=1e-3
    )


def test_without_pixels_the_voxels_are_the_same() -> None:
    backbone, images = make_backbone(num_blocks=2), torch.rand(1, 2, 3, 32, 32)
    full = backbone(images, **scene())
    alone = backbone(images, **scene(), with_pixels=False)
    assert full[1].shape == (1, 2, 2, 2, 8)
    assert alone[1] is None
    torch.testing.assert_close(full[0], alone[0])


def test_channels_must_split_into_heads() -> None:
    with pytest.raises(ConfigError, match="num_heads=3"):
        Backbone(resnet=ResNet18(width=4), channels=16, num_heads=3)


def test_checkpointed_blocks_give_the_same_gradients_from_less_memory() -> None:
    images, kept, gradients = torch.rand(1, 2, 3, 32, 32), [], []
    for checkpoint_blocks in (False, True):
        backbone = make_backbone(num_blocks=3).train()
        backbone.checkpoint_blocks = checkpoint_blocks
        saved: list[int] = []

        def keep(tensor: torch.Tensor, saved: list[int] = saved) -> torch.Tensor:
            saved.append(tensor.numel())
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            voxels, pixels = backbone(images, **scene())
        (voxels.square().sum() + pixels.square().sum()).backward()
        kept.append(sum(saved))
        gradients.append({name: parameter.grad for name, parameter in backbone.named_parameters()})
    assert kept[1] < kept[0]
    assert gradients[0].keys() == gradients[1].keys()
    for name, gradient in gradients[0].items():
        assert torch.equal(gradient, gradients[1][name]), name
