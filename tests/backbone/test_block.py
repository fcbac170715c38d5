# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import torch

from raytran.backbone.block import RayTracedBlock
from raytran.ops.pairs import PairList


def one_pair(pixel: int, voxel: int, *, num_pixels: int = 12, num_voxels: int = 8) -> PairList:
    return PairList(torch.tensor([pixel]), torch.tensor([voxel]), num_pixels, num_voxels)


def silence_feed_forwards(block: RayTracedBlock) -> None:
    for stream in (block.voxel_stream, block.pixel_stream):
        torch.nn.init.zeros_(stream.feed_forward.output.weight)
        torch.nn.init.zeros_(stream.feed_forward.output.bias)
        torch.nn.init.zeros_(stream.output.bias)


def test_both_streams_read_the_blocks_input(generator: torch.Generator) -> None:
    """With one pair the attention is the value of the other side: computed here by hand."""
    torch.manual_seed(0)
    block = RayTracedBlock(channels=8, num_heads=2)
    silence_feed_forwards(block)
    voxels, pixels = (
        torch.randn(1, 2, 2, 2, 8, generator=generator),
        torch.randn(1, 3, 4, 8, generator=generator),
    )
    new_voxels, (new_pixels,) = block(voxels, [pixels], [one_pair(5, 3)])
    voxel_stream, pixel_stream = block.voxel_stream, block.pixel_stream
    to_voxel = voxel_stream.output(voxel_stream.value(block.pixel_norm(pixels).view(-1, 8)[5]))
    to_pixel = pixel_stream.output(pixel_stream.value(block.voxel_norm(voxels).view(-1, 8)[3]))
    torch.testing.assert_close((new_voxels - voxels).view(-1, 8)[3], to_voxel)
    torch.testing.assert_close((new_pixels - pixels).view(-1, 8)[5], to_pixel)
    others = [i for i in range(12) if i != 5]
    torch.testing.assert_close((new_pixels - pixels).view(-1, 8)[others], torch.zeros(11, 8))


def test_feed_forwards_reach_neighbours_of_their_own_space() -> None:
    """A change of one voxel spreads to the 3×3×3 voxels around it and, without a pair, to no pixel."""
    torch.manual_seed(0)
    block = RayTracedBlock(channels=4, num_heads=1)
    voxels, pixels = torch.randn(1, 5, 5, 5, 4), torch.randn(2, 3, 4, 4)
    none = PairList(torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long), 24, 125)
    moved = voxels.clone()
    moved[0, 2, 2, 2] += torch.tensor([1.0, -2.0, 3.0, 0.5])
    before, after = block(voxels, [pixels], [none]), block(moved, [pixels], [none])
    changed = (before[0] - after[0]).abs().amax(-1)[0] > 0
    expected = torch.zeros(5, 5, 5, dtype=torch.bool)
    expected[1:4, 1:4, 1:4] = True
    assert torch.equal(changed, expected)
    torch.testing.assert_close(before[1][0], after[1][0])


def test_pixels_can_be_left_alone() -> None:
    block = RayTracedBlock(channels=4, num_heads=1)
    voxels, pixels = torch.randn(1, 2, 2, 2, 4), torch.randn(1, 3, 4, 4)
    full, alone = (block(voxels, [pixels], [one_pair(0, 0)], update_pixels=flag) for flag in (True, False))
    torch.testing.assert_close(full[0], alone[0])
    assert alone[1][0] is pixels
