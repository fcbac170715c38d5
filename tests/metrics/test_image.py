# SPDX-License-Identifier: Apache-2.0
"""PSNR and SSIM against scikit-image, frame by frame."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from raytran.errors import ShapeError
from raytran.metrics import PSNR, SSIM

SHAPE = (2, 3, 3, 24, 32)


@pytest.fixture
def images(generator) -> tuple[torch.Tensor, torch.Tensor]:
    rows = torch.linspace(0, 1, 24)[:, None].expand(SHAPE)
    target = (rows + 0.2 * torch.rand(SHAPE, generator=generator)) / 1.2
    noise = torch.linspace(0.01, 0.3, 6).reshape(2, 3, 1, 1, 1)  # so that frames differ much in quality
    return (target + noise * torch.randn(SHAPE, generator=generator)).clamp(0, 1), target


def frames(images) -> list[tuple[np.ndarray, np.ndarray]]:
    predicted, target = (side.flatten(0, 1).movedim(1, -1).double().numpy() for side in images)
    return list(zip(predicted, target, strict=True))


def test_psnr_is_the_mean_over_frames(images):
    metric = PSNR()
    metric.update(*images, ["a", "b"])
    expected = [peak_signal_noise_ratio(true, found, data_range=1.0) for found, true in frames(images)]
    assert metric.compute().item() == pytest.approx(np.mean(expected), abs=1e-4)
    metric.update(images[0][:1], images[1][:1], ["a"])  # a repeated scene changes nothing
    assert metric.compute().item() == pytest.approx(np.mean(expected), abs=1e-4)


def slow_ssim(true: np.ndarray, found: np.ndarray) -> float:
    """The mean over all pixels, images mirrored at the border (scikit-image leaves the border out)."""
    mirrored = (np.pad(image, ((5, 5), (5, 5), (0, 0)), mode="reflect") for image in (true, found))
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "full": True}
    return structural_similarity(*mirrored, data_range=1.0, channel_axis=-1, **settings)[1][5:-5, 5:-5].mean()


def test_ssim_is_the_mean_over_frames(images):
    metric = SSIM()
    metric.update(*images, ["a", "b"])
    expected = [slow_ssim(true, found) for found, true in frames(images)]
    assert metric.compute().item() == pytest.approx(np.mean(expected), abs=1e-4)
    one = SSIM()
    one.update(images[0][:1, :1], images[1][:1, :1], ["a"])
    assert one.compute().item() == pytest.approx(expected[0], abs=1e-4)


def test_equal_images_and_none():
    image = torch.rand(1, 1, 3, 16, 16)
    psnr, ssim = PSNR(), SSIM()
    for metric in (psnr, ssim):
        metric.update(image, image, ["a"])
    assert math.isinf(psnr.compute().item())
    assert ssim.compute().item() == pytest.approx(1.0)
    empty = PSNR()
    empty.update(torch.zeros(0, 1, 3, 16, 16), torch.zeros(0, 1, 3, 16, 16), [])
    assert math.isnan(empty.compute().item())


def test_shapes_are_checked():
    image = torch.rand(1, 1, 3, 16, 16)
    with pytest.raises(ShapeError, match="a name for each scene"):
        PSNR().update(image, image, ["a", "b"])
    with pytest.raises(ShapeError, match="B, N, 3, H, W"):
        SSIM().update(image[0], image[0], ["a"])
