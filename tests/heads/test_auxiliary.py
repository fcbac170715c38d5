# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import torch

from raytran.heads.auxiliary import ForegroundHead, OccupancyHead


def test_one_convolution_over_the_voxels() -> None:
    head = OccupancyHead(channels=8)
    assert sum(p.numel() for p in head.parameters()) == 8 * 27 + 1
    voxels = torch.randn(2, 4, 5, 6, 8)
    expected = torch.nn.functional.conv3d(
        voxels.permute(0, 4, 1, 2, 3), head.convolution.weight, head.convolution.bias, padding=1
    )
    torch.testing.assert_close(head(voxels), expected[:, 0])


def test_masks_have_image_size() -> None:
    head = ForegroundHead(channels=16, widths=(8, 8, 4))
    assert head(torch.randn(2, 3, 2, 4, 16)).shape == (2, 3, 32, 64)


def test_full_resolution_holds_one_channel() -> None:
    """At 20 frames of 640×480 each channel there costs 25 MB, and as much again for its gradient."""
    head = ForegroundHead()
    assert head.upsampler[-1].out_channels == 1
    assert max(layer.out_channels for layer in head.upsampler if hasattr(layer, "out_channels")) == 128


def test_a_view_does_not_depend_on_the_others() -> None:
    head = ForegroundHead(channels=16, widths=(8, 8, 4))
    pixels = torch.randn(1, 3, 2, 4, 16)
    torch.testing.assert_close(head(pixels)[:, 1:2], head(pixels[:, 1:2]))
