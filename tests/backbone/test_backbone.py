# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch

from raytran.backbone.backbone import Backbone
from raytran.backbone.resnet import ResNet18
from raytran.errors import ConfigError
from raytran.extensions.efficientnet import EfficientNetLite0
from raytran.extensions.unet3d import VoxelEncoderDecoder
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList

from ..factories import run_backbone


def make_backbone(num_blocks: int = 1) -> Backbone:
    torch.manual_seed(0)
    return Backbone(encoder=ResNet18(width=8), channels=8, num_heads=2, num_blocks=num_blocks).eval()


def scene(center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    """Two views of 2×2 cells; pixel i sees voxel i of the first 8 of 12 voxels."""
    pose = torch.eye(4).repeat(1, 2, 1, 1)
    pose[..., :3, 3] = torch.tensor(center) + torch.tensor([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    intrinsics = torch.tensor([[20.0, 0, 16], [0, 20, 16], [0, 0, 1]]).expand(1, 2, 3, 3)
    return {
        "cameras": Cameras(intrinsics, pose, (32, 32)),
        "grid": VoxelGrid((2, 2, 3), (2.0, 2.0, 3.0), torch.tensor([center])),
        "trace": lambda _: PairList(torch.arange(8), torch.arange(8), 8, 12),
    }


def test_voxels_start_as_mean_features_or_unseen() -> None:
    backbone, start = make_backbone(), {}
    torch.nn.init.zeros_(backbone.voxel_position.weight)
    torch.nn.init.zeros_(backbone.voxel_position.bias)
    backbone.blocks[0].register_forward_pre_hook(
        lambda _, inputs: start.update(voxels=inputs[0], pixels=inputs[1][0])
    )
    run_backbone(backbone, torch.rand(1, 2, 3, 32, 32), **scene())
    voxels, pixels = start["voxels"].view(12, 8), start["pixels"].reshape(8, 8)
    torch.testing.assert_close(voxels[:8], pixels)
    torch.testing.assert_close(voxels[8:], backbone.unseen.expand(4, 8))


def test_images_are_normalised_as_imagenets() -> None:
    backbone, seen = make_backbone(), {}
    backbone.encoder.register_forward_pre_hook(lambda _, inputs: seen.update(images=inputs[0]))
    run_backbone(backbone, torch.full((1, 2, 3, 32, 32), 255, dtype=torch.uint8), **scene())
    # (1 - 0.485) / 0.229, (1 - 0.456) / 0.224, (1 - 0.406) / 0.225
    torch.testing.assert_close(seen["images"][0, :, 0, 0], torch.tensor([2.24890, 2.42857, 2.64000]))


@pytest.mark.parametrize("kind", [ResNet18, EfficientNetLite0])
def test_a_mask_is_left_as_it_is(kind) -> None:
    """Beside normalised colours the fourth channel is 0 and 1."""
    torch.manual_seed(0)
    encoder = kind(input_channels=4)
    backbone, seen = Backbone(encoder=encoder, channels=8, num_heads=2, num_blocks=1).eval(), {}
    backbone.encoder.register_forward_pre_hook(lambda _, inputs: seen.update(images=inputs[0]))
    images = torch.randint(0, 256, (1, 2, 4, 32, 32), dtype=torch.uint8)
    images[:, :, 3] = 255 * (images[:, :, 3] > 99)
    run_backbone(backbone, images, **scene())
    assert torch.equal(seen["images"][:, 3], (images[0, :, 3] == 255).float())
    mean, std = (torch.tensor(v)[:, None, None] for v in (encoder.image_mean, encoder.image_std))
    torch.testing.assert_close(seen["images"][:, :3], (images[0, :, :3] / 255 - mean) / std)


def test_features_do_not_depend_on_where_the_world_has_its_origin() -> None:
    backbone, images = make_backbone(), torch.rand(1, 2, 3, 32, 32)
    here, there = (
        run_backbone(backbone, images, **scene()),
        run_backbone(backbone, images, **scene((30.0, -8.0, 2.0))),
    )
    torch.testing.assert_close(here[0], there[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(here[1], there[1], rtol=1e-4, atol=1e-5)


def test_pixels_know_their_rays() -> None:
    """The same two images from other camera positions in the grid give other pixel features."""
    backbone, images = make_backbone(), torch.rand(1, 2, 3, 32, 32)
    here, there = scene(), scene((0.0, 0.0, 0.7))
    _, pixels = run_backbone(backbone, images, **here)
    _, other = run_backbone(backbone, images, **{**here, "cameras": there["cameras"]})
    assert not torch.allclose(pixels, other, atol=1e-3)


def test_without_pixels_the_voxels_are_the_same() -> None:
    backbone, images = make_backbone(num_blocks=2), torch.rand(1, 2, 3, 32, 32)
    full = run_backbone(backbone, images, **scene())
    alone = run_backbone(backbone, images, **scene(), with_pixels=False)
    assert full[1].shape == (1, 2, 2, 2, 8)
    assert alone[1] is None
    torch.testing.assert_close(full[0], alone[0])


def test_one_direction_leaves_the_pixels_as_the_encoder_made_them(generator: torch.Generator) -> None:
    both, one = make_backbone(num_blocks=2), make_backbone(num_blocks=2)
    one.bidirectional = False
    images = torch.rand(1, 2, 3, 32, 32, generator=generator)
    entered: dict[str, Any] = {}
    one.blocks[0].register_forward_pre_hook(lambda _, inputs: entered.update(first=inputs))
    voxels, pixels = run_backbone(one, images, **scene())
    start, embedded, pairs = entered["first"]
    torch.testing.assert_close(pixels[0], one.pixel_norm(embedded[0]))
    before, _ = both.blocks[0](start, embedded, pairs)
    after, _ = both.blocks[1](before, embedded, pairs)
    torch.testing.assert_close(voxels, both.voxel_norm(after))
    assert not torch.allclose(voxels, run_backbone(both, images, **scene())[0], atol=1e-3)


@pytest.mark.parametrize("with_pixels", [True, False])
def test_no_gradient_reaches_what_one_direction_leaves_out(with_pixels: bool) -> None:
    backbone = make_backbone(num_blocks=2).train()
    backbone.bidirectional = False
    voxels, pixels = run_backbone(backbone, torch.rand(1, 2, 3, 32, 32), **scene(), with_pixels=with_pixels)
    ((voxels**3).sum() + (0.0 if pixels is None else (pixels**3).sum())).backward()
    without = {name for name, parameter in backbone.named_parameters() if parameter.grad is None}
    idle = backbone.idle_modules(with_pixels=with_pixels)
    assert without == {name for name, _ in backbone.named_parameters() if name.startswith(idle)}


@pytest.mark.parametrize("with_pixels", [True, False])
def test_no_gradient_reaches_a_frozen_encoder(with_pixels: bool) -> None:
    torch.manual_seed(0)
    encoder = EfficientNetLite0(stride=16, num_stages=4, frozen=True)
    backbone = Backbone(encoder=encoder, channels=8, num_heads=2, num_blocks=1).requires_grad_().train()
    idle = backbone.idle_modules(with_pixels=with_pixels)
    assert idle[0] == "image_features.encoder"
    for name, parameter in backbone.named_parameters():
        parameter.requires_grad_(not name.startswith(idle))
    voxels, pixels = run_backbone(backbone, torch.rand(1, 2, 3, 32, 32), **scene(), with_pixels=with_pixels)
    ((voxels**3).sum() + (0.0 if pixels is None else (pixels**3).sum())).backward()
    without = {name for name, parameter in backbone.named_parameters() if parameter.grad is None}
    assert without == {name for name, _ in backbone.named_parameters() if name.startswith(idle)}


def test_a_voxel_network_runs_before_the_first_block_and_leaves_the_rest_as_it_was() -> None:
    def make(voxel_network: Any) -> Backbone:
        torch.manual_seed(0)
        return Backbone(
            encoder=ResNet18(width=8), channels=8, num_heads=2, num_blocks=1, voxel_network=voxel_network
        ).eval()

    plain, deep = make(None), make(partial(VoxelEncoderDecoder, num_levels=2))
    names = set(deep.state_dict()) - set(plain.state_dict())
    assert names
    assert all(name.startswith("voxel_network.") for name in names)
    for name, value in plain.state_dict().items():
        assert torch.equal(value, deep.state_dict()[name]), name
    entered: dict[str, torch.Tensor] = {}
    for key, backbone in (("plain", plain), ("deep", deep)):
        backbone.blocks[0].register_forward_pre_hook(
            lambda _, inputs, key=key: entered.update({key: inputs[0].detach()})
        )
        run_backbone(backbone, torch.full((1, 2, 3, 32, 32), 0.3), **scene())
    torch.testing.assert_close(entered["deep"], deep.voxel_network(entered["plain"]))
    assert not torch.allclose(entered["deep"], entered["plain"])


def test_channels_must_split_into_heads() -> None:
    with pytest.raises(ConfigError, match="3 heads"):
        Backbone(encoder=ResNet18(width=8), channels=16, num_heads=3)


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
            voxels, pixels = run_backbone(backbone, images, **scene())
        (voxels.square().sum() + pixels.square().sum()).backward()
        kept.append(sum(saved))
        gradients.append({name: parameter.grad for name, parameter in backbone.named_parameters()})
    assert kept[1] < kept[0]
    assert gradients[0].keys() == gradients[1].keys()
    for name, gradient in gradients[0].items():
        assert torch.equal(gradient, gradients[1][name]), name
