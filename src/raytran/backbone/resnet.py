# SPDX-License-Identifier: Apache-2.0
"""ResNet-18 at stride 16 or 8 with torchvision's parameter names (He et al., CVPR 2016)."""

from __future__ import annotations

from pathlib import Path
from urllib.error import URLError

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from raytran.backbone.backbone import ImageEncoder
from raytran.backbone.encoder_weights import imagenet_or_random, load_state, read_state
from raytran.errors import CheckpointError, ConfigError

IMAGENET_URL = "https://download.pytorch.org/models/resnet18-f37072fd.pth"
"""torchvision's ``ResNet18_Weights.IMAGENET1K_V1``; the name carries the first digits of its SHA-256."""


MIN_WIDTH = 8
"""Fewest channels of a stage. With fewer, the gradient of the strided 1×1 convolution behind the first stage
writes beyond its memory on CPUs without AVX-512 (oneDNN in torch 2.13, channels-last), which ends the process
somewhere later."""


class BasicBlock(nn.Module):
    """Two 3×3 convolutions with a skip."""

    def __init__(self, in_channels: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.downsample: nn.Module | None = None
        if stride != 1 or in_channels != channels:
            self.downsample = nn.Sequential(
                nn.Conv2d(in_channels, channels, 1, stride, bias=False), nn.BatchNorm2d(channels)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(n, C, H, W)`` to ``(n, C', H/stride, W/stride)``."""
        out = torch.relu_(self.bn1(self.conv1(x)))
        out = self.bn2(self.conv2(out))
        return torch.relu_(out + (x if self.downsample is None else self.downsample(x)))


class ResNet18(ImageEncoder):
    """The trunk of ResNet-18 without its classifier.

    The last stage keeps its resolution, so the output has stride 16: 640×480 gives the paper's 40×30.

    Args:
        width: channels of the first stage, ``MIN_WIDTH`` at least; 64 is ResNet-18, the output has
            ``8 · width``.
        stride: image pixels along each side of a feature cell, 16 (the paper) or 8, where the third stage
            keeps its resolution too: small images then keep more cells.
        norm_momentum: share of each batch in the running statistics that batch norms predict with; a tenth
            remembers ten batches, which is few where a batch is the views of one scene.
        input_channels: 3, or 4 with a mask as input (RayTran §4). Weights for three channels are kept and
            the fourth starts at zero, so that the network begins as the pretrained one.
        weights: None (random), ``"imagenet"`` (fetched by URL, hash checked), ``"auto"`` (the same, but
            random with a warning where they cannot be fetched), or a file with a state dict under
            torchvision's names, with or without ``fc``. Needed only at construction.

    Attributes:
        random_fallback: the weights are random because ``"auto"`` found none.

    Raises:
        ConfigError: the width is too small, weights are given for another width than 64, or the stride is
            neither 16 nor 8.
        CheckpointError: the weights cannot be fetched, read, or do not fit.
    """

    image_mean = (0.485, 0.456, 0.406)
    image_std = (0.229, 0.224, 0.225)

    def __init__(
        self,
        *,
        width: int = 64,
        stride: int = 16,
        norm_momentum: float = 0.1,
        input_channels: int = 3,
        weights: str | Path | None = None,
    ) -> None:
        super().__init__()
        if width < MIN_WIDTH:
            raise ConfigError(f"resnet width must be {MIN_WIDTH} or more, got {width}")
        if stride not in (8, 16):
            raise ConfigError(f"resnet stride must be 8 or 16, got {stride}")
        self.stride = stride
        self.input_channels = input_channels
        self.random_fallback = False
        self.out_channels = 8 * width
        self.conv1 = nn.Conv2d(input_channels, width, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        self.layer1 = _stage(width, width, stride=1)
        self.layer2 = _stage(width, 2 * width, stride=2)
        self.layer3 = _stage(2 * width, 4 * width, stride=stride // 8)
        self.layer4 = _stage(4 * width, 8 * width, stride=1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        set_norm_momentum(self, norm_momentum)
        if weights is not None:
            if width != 64:
                raise ConfigError(
                    f"pretrained weights need resnet width 64, got {width}: "
                    "set model.backbone.encoder.width=64, or model.backbone.encoder.weights=null"
                )
            self._load(weights)

    def forward(self, images: Tensor) -> Tensor:
        """Map normalised images ``(n, 3 or 4, H, W)`` to features ``(n, 8 · width, H/stride, W/stride)``."""
        # Channels last: convolutions are faster, and the features come out in the order that is wanted next.
        images = images.contiguous(memory_format=torch.channels_last)
        x = self.maxpool(torch.relu_(self.bn1(self.conv1(images))))
        return self.layer4(self.layer3(self.layer2(self.layer1(x))))

    def _load(self, weights: str | Path) -> None:
        if weights in ("imagenet", "auto"):
            state = imagenet_or_random(_fetch_imagenet, required=weights == "imagenet")
            if state is None:
                self.random_fallback = True
                return
        else:
            remedy = (
                f"download {IMAGENET_URL} there, or set weights=imagenet, or weights=null for a random start"
            )
            state = read_state(Path(weights), name="ResNet-18", remedy=remedy)
        state = {key: value for key, value in state.items() if not key.startswith("fc.")}
        load_state(self, state, first="conv1.weight", source=weights, name="ResNet-18")


def _stage(in_channels: int, channels: int, *, stride: int) -> nn.Sequential:
    return nn.Sequential(BasicBlock(in_channels, channels, stride), BasicBlock(channels, channels, 1))


def _fetch_imagenet() -> dict[str, Tensor]:
    name = IMAGENET_URL.rsplit("/", 1)[1]
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    try:
        return torch.hub.load_state_dict_from_url(IMAGENET_URL, map_location="cpu", check_hash=True)
    except (URLError, OSError, RuntimeError) as error:
        raise CheckpointError(
            f"could not fetch the ImageNet weights ({error}): download {IMAGENET_URL} and put it at "
            f"{folder / name}, or start at random with model.backbone.encoder.weights=null"
        ) from error


def set_norm_momentum(network: nn.Module, momentum: float) -> None:
    """Set the share of each batch in the running statistics of all batch norms of ``network``.

    With few scenes a step a batch is the views of one or two scenes, and its statistics are poor.
    """
    for module in network.modules():
        if isinstance(module, _BatchNorm):
            module.momentum = momentum
