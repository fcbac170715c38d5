# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from urllib.error import URLError

import pytest
import torch

from raytran.backbone.resnet import ResNet18
from raytran.errors import CheckpointError, ConfigError


def test_parameters_are_torchvisions() -> None:
    """Names and the count (11,689,512 with the classifier's 513,000) are those of torchvision's resnet18."""
    network = ResNet18()
    keys = set(network.state_dict())
    assert sum(p.numel() for p in network.parameters()) == 11_176_512
    assert len(keys) == 120
    assert {
        "conv1.weight",
        "bn1.running_mean",
        "layer1.0.conv1.weight",
        "layer1.1.bn2.num_batches_tracked",
        "layer2.0.downsample.0.weight",
        "layer2.0.downsample.1.running_var",
        "layer3.1.conv2.weight",
        "layer4.1.bn2.bias",
    } <= keys
    assert network.state_dict()["layer4.0.downsample.0.weight"].shape == (512, 256, 1, 1)


def test_stride_is_16() -> None:
    assert ResNet18(width=8)(torch.randn(2, 3, 48, 64)).shape == (2, 64, 3, 4)


def test_stride_8_keeps_the_same_parameters() -> None:
    fine = ResNet18(width=8, stride=8)
    assert fine(torch.randn(2, 3, 48, 64)).shape == (2, 64, 6, 8)
    fine.load_state_dict(ResNet18(width=8).state_dict())
    with pytest.raises(ConfigError, match="8 or 16"):
        ResNet18(width=8, stride=4)


@pytest.mark.parametrize("with_classifier", [True, False])
def test_loads_a_file_in_torchvisions_naming(tmp_path: Path, with_classifier: bool) -> None:
    source = ResNet18().eval()
    state = dict(source.state_dict())
    if with_classifier:
        state |= {"fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}
    path = tmp_path / "resnet18.pth"
    torch.save(state, path)
    images = torch.randn(1, 3, 32, 32)
    torch.testing.assert_close(ResNet18(weights=path).eval()(images), source(images))


def test_fourth_channel_begins_without_effect(tmp_path: Path) -> None:
    source = ResNet18().eval()
    path = tmp_path / "resnet18.pth"
    torch.save(source.state_dict(), path)
    masked = ResNet18(weights=path, input_channels=4).eval()
    images = torch.randn(1, 4, 32, 32)
    torch.testing.assert_close(masked(images), source(images[:, :3]))
    masked(images).sum().backward()
    assert masked.conv1.weight.grad[:, 3].abs().sum() > 0


def test_imagenet_weights_are_fetched_with_their_hash_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    source = ResNet18()
    calls: list[tuple[str, object]] = []

    def fetch(url: str, *, check_hash: bool = False, **_: object) -> dict[str, torch.Tensor]:
        calls.append((url, check_hash))
        return dict(source.state_dict())

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", fetch)
    network = ResNet18(weights="imagenet")
    assert calls == [("https://download.pytorch.org/models/resnet18-f37072fd.pth", True)]
    torch.testing.assert_close(network.conv1.weight, source.conv1.weight)


def test_offline_the_error_says_what_to_put_where(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise URLError("no network")

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", fail)
    place = Path(torch.hub.get_dir()) / "checkpoints" / "resnet18-f37072fd.pth"
    with pytest.raises(CheckpointError, match=r"download https://download.pytorch.org") as caught:
        ResNet18(weights="imagenet")
    assert str(place) in str(caught.value)


def test_auto_goes_on_with_random_weights_offline_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise URLError("no network")

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", fail)
    torch.manual_seed(0)
    network = ResNet18(weights="auto")
    torch.manual_seed(0)
    torch.testing.assert_close(network.conv1.weight, ResNet18().conv1.weight)
    assert "random weights" in caplog.text
    assert "download https://download.pytorch.org" in caplog.text


def test_missing_damaged_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no ResNet-18 weights at"):
        ResNet18(weights=tmp_path / "absent.pth")
    whole = tmp_path / "whole.pth"
    torch.save(ResNet18().state_dict(), whole)
    half = tmp_path / "half.pth"
    half.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.raises(CheckpointError, match=r"half\.pth is not a readable"):
        ResNet18(weights=half)
    foreign = tmp_path / "foreign.pth"
    torch.save({"features.0.weight": torch.zeros(1)}, foreign)
    with pytest.raises(CheckpointError, match=r"foreign\.pth does not fit"):
        ResNet18(weights=foreign)


def test_pretrained_weights_have_one_width() -> None:
    with pytest.raises(ConfigError, match="width 64, got 16"):
        ResNet18(width=16, weights="imagenet")


def test_a_width_that_corrupts_memory_on_some_processors_is_refused() -> None:
    with pytest.raises(ConfigError, match="resnet width must be 8 or more, got 4"):
        ResNet18(width=4)


def test_the_smallest_width_leaves_the_memory_whole_on_a_processor_without_avx_512() -> None:
    script = """
import torch
from raytran.backbone.resnet import MIN_WIDTH, ResNet18
network = ResNet18(width=MIN_WIDTH)
for _ in range(20):
    network(torch.randn(2, 3, 32, 48)).sum().backward()
"""
    slow = {"ONEDNN_MAX_CPU_ISA": "AVX2", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | slow, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
