# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.extensions.unet3d import VoxelEncoderDecoder


@pytest.mark.parametrize(("size", "num_levels"), [((7, 4, 5), 3), ((8, 8, 8), 4), ((3, 2, 2), 1)])
def test_any_size_of_volume_comes_back(size: tuple[int, int, int], num_levels: int) -> None:
    network = VoxelEncoderDecoder(channels=4, num_blocks=1, num_levels=num_levels).eval()
    assert network(torch.rand(2, *size, 4)).shape == (2, *size, 4)


def test_coarser_levels_see_further(generator: torch.Generator) -> None:
    """Without them two convolutions reach two voxels, with them the other end of the volume."""
    reached = []
    for num_levels in (1, 3):
        torch.manual_seed(0)
        network = VoxelEncoderDecoder(channels=16, num_blocks=1, num_levels=num_levels).eval()
        voxels = torch.rand(1, 16, 1, 1, 16, generator=generator).requires_grad_()
        network(voxels)[0, 0].sum().backward()
        reached.append(int(voxels.grad.abs().sum(dim=-1).flatten().nonzero().max()))
    assert reached[0] == 2
    assert reached[1] > 4
