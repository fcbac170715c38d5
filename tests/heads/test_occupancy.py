# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import torch

from raytran.heads.occupancy import OccupancyHead


def test_one_convolution_over_the_voxels() -> None:
    head = OccupancyHead(channels=8)
    assert sum(p.numel() for p in head.parameters()) == 8 * 27 + 1
    voxels = torch.randn(2, 4, 5, 6, 8)
    expected = torch.nn.functional.conv3d(
        voxels.permute(0, 4, 1, 2, 3), head.convolution.weight, head.convolution.bias, padding=1
    )
    torch.testing.assert_close(head(voxels), expected[:, 0])
