# SPDX-License-Identifier: Apache-2.0
"""The 2D features P⁰ of each view: an image encoder and a projection to C channels (RayTran §3.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from raytran.errors import ShapeError, check_shape


class ImageEncoder(nn.Module):
    """The interface of an image encoder: the base of ``ResNet18`` and of encoders of your own.

    Called with normalised images ``(n, input_channels, H, W)``, it returns features
    ``(n, out_channels, H/stride, W/stride)``.

    Attributes:
        stride: image pixels along each side of a feature cell.
        input_channels: 3, or 4 with a foreground mask.
        out_channels: channels of the features.
        image_mean: mean of red, green and blue in [0, 1] in the images its weights were trained on.
        image_std: their standard deviation.
        frozen: its weights never train.
        random_fallback: it should have started from pretrained weights and found none.
    """

    stride: int
    input_channels: int
    out_channels: int
    image_mean: tuple[float, float, float]
    image_std: tuple[float, float, float]
    frozen: bool = False
    random_fallback: bool = False


class ImageFeatures(nn.Module):
    """Images → features of ``C`` channels at the encoder's stride, each view on its own.

    Args:
        encoder: the image encoder.
        channels: C.
    """

    image_mean: Tensor
    image_std: Tensor

    def __init__(self, *, encoder: ImageEncoder, channels: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.projection = nn.Linear(encoder.out_channels, channels)
        # A mask channel is no colour: it goes in as it is.
        shift = [*encoder.image_mean, 0.0]
        scale = [*encoder.image_std, 1.0]
        self.register_buffer("image_mean", torch.tensor(shift[: encoder.input_channels]), persistent=False)
        self.register_buffer("image_std", torch.tensor(scale[: encoder.input_channels]), persistent=False)

    @property
    def stride(self) -> int:
        """Image pixels along each side of a feature cell."""
        return self.encoder.stride

    def forward(self, images: Tensor) -> Tensor:
        """Return pixel features ``(B · N, h, w, C)``.

        Args:
            images: ``(B, N, 3 or 4, H, W)`` uint8, or floating point in [0, 1].

        Raises:
            ShapeError: images have other channels than the encoder, or sides not divisible by the stride.
        """
        if images.ndim != 5 or images.shape[2] != self.encoder.input_channels:
            check_shape(images, f"B N {self.encoder.input_channels} H W", "images")
        if images.shape[-2] % self.stride or images.shape[-1] % self.stride:
            raise ShapeError(
                f"expected images with sides divisible by {self.stride}, got {tuple(images.shape[-2:])}"
            )
        scaled = images.flatten(0, 1).to(self.image_mean.dtype)
        if not images.is_floating_point():
            scaled = scaled / 255
        normalized = (scaled - self.image_mean[:, None, None]) / self.image_std[:, None, None]
        return self.projection(self.encoder(normalized).movedim(1, -1))
