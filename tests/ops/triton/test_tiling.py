# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.ops.triton.tiling import Tiling


@pytest.mark.parametrize(
    "tiling",
    [Tiling.of_pixels(110, (2, 5, 11)), Tiling.of_voxels(280, (2, 5, 4, 7)), Tiling.of_run(70)],
)
def test_every_element_lies_where_its_tile_says(tiling):
    n, a, b, c = torch.meshgrid(*map(torch.arange, tiling.shape), indexing="ij")
    (x, y, z), (u, v, w), sizes = tiling.tile, tiling.part, tiling.tiles
    tile = ((n * sizes[1] + a // x) * sizes[2] + b // y) * sizes[3] + c // z
    part = (a % x // u * (y // v) + b % y // v) * (z // w) + c % z // w
    slot = part * 8 + (a % u * v + b % v) * w + c % w
    element = torch.arange(tiling.num_elements)
    found_tile, found_slot = tiling.locate(element)
    assert torch.equal(found_tile, tile.flatten())
    assert torch.equal(found_slot, slot.flatten())
    assert torch.equal(tiling.start(found_tile) + tiling.offset(found_slot), element)
