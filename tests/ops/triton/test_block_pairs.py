# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.errors import ShapeError
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList
from raytran.ops.reference import pair_mask
from raytran.ops.traverse import trace_pairs
from raytran.ops.triton import block_pairs
from raytran.ops.triton.block_pairs import BlockPairs

SHAPES = [
    ((3, 8, 16), (1, 8, 4, 4)),
    ((2, 3, 5), (2, 5, 3, 6)),
    ((5, 9, 7), (1, 1, 1, 1)),
    ((1, 1, 1), (2, 9, 4, 5)),
]


@pytest.mark.parametrize(("pixel_shape", "voxel_shape"), SHAPES)
def test_blocks_hold_the_pairs_and_no_others(shaped_pairs, pixel_shape, voxel_shape):
    pairs = shaped_pairs(pixel_shape, voxel_shape, 0.2)
    back = PairList.from_blocks(pairs.blocks())
    assert torch.equal(back.pixel_index, pairs.pixel_index)
    assert torch.equal(back.voxel_index, pairs.voxel_index)
    assert pairs.blocks() is pairs.blocks()


def test_pairs_of_unknown_layout(random_pairs):
    pairs = random_pairs(70, 150, 0.1)
    assert pairs.blocks().pixels.tiles == (1, 1, 1, 3)
    assert pairs.blocks().voxels.tiles == (1, 1, 1, 5)
    assert torch.equal(PairList.from_blocks(pairs.blocks()).voxel_index, pairs.voxel_index)


def test_masks_by_hand():
    # Pixel (row 3, column 7) is the last of the first tile. Voxel (2, 0, 1) is the second of the second block
    # along x, voxel (1, 3, 3) the last of the first.
    pairs = PairList(torch.tensor([55, 55]), torch.tensor([31, 33]), 96, 128, (1, 6, 16), (1, 8, 4, 4))
    blocks = pairs.blocks()
    assert blocks.key.tolist() == [0, 1]
    sign = -(2**31)
    assert blocks.masks[0].tolist() == [[0] * 31 + [sign], [0] * 31 + [sign]]
    assert blocks.masks[1].tolist() == [[0, sign] + [0] * 30, [0] * 31 + [2]]
    # The row of the tile has the last part of the first block, which begins at (0, 2, 2), and the first of
    # the second, those of the blocks the last part of the tile, which begins at (2, 4).
    order = blocks.by("pixels")
    assert order.part_start[:2].tolist() == [10, 32]
    assert order.place[:2].tolist() == [3, 8]
    order = blocks.by("voxels")
    assert order.part_start[:2].tolist() == [36, 36]
    assert order.place[:2].tolist() == [7, 15]


@pytest.mark.parametrize("unused", [0, 40])
@pytest.mark.parametrize("side", ["pixels", "voxels"])
def test_items_cover_every_row_once_and_long_rows_in_pieces(shaped_pairs, monkeypatch, side, unused):
    monkeypatch.setattr(block_pairs, "_SLOTS", 20)
    pairs = shaped_pairs((50, 4, 9), (1, 8, 5, 3), 0.05)
    blocks = pairs.blocks()
    end = blocks.pixels.num_tiles * blocks.voxels.num_tiles
    blocks = BlockPairs(
        torch.cat([blocks.key, torch.full((unused,), end)]),
        torch.cat([blocks.masks, torch.zeros(unused, 2, 32, dtype=torch.int32)]),
        blocks.pixels,
        blocks.voxels,
    )
    rows, others = (blocks.pixels, blocks.voxels)[:: 1 if side == "pixels" else -1]
    order = blocks.by(side)
    slots: dict[int, list[int]] = {}
    visited: dict[int, list[tuple[int, int]]] = {}
    lengths = []
    for start, first, last, slot in order.items.tolist():
        if start < 0:
            continue
        lengths.append(last - first)
        parts = zip(order.part_start[first:last].tolist(), order.place[first:last].tolist(), strict=True)
        visited.setdefault(start, []).extend(parts)
        if slot >= 0:
            slots.setdefault(start, []).append(slot)
    assert lengths == sorted(lengths, reverse=True)
    tile, block = blocks.key // blocks.voxels.num_tiles, blocks.key % blocks.voxels.num_tiles
    row, other = (tile, block)[:: 1 if side == "pixels" else -1]
    assert sorted(visited) == sorted(rows.start(torch.arange(rows.num_tiles)).tolist())
    for number in range(rows.num_tiles):
        expected = [
            (
                int(others.start(other[k]) + others.offset(torch.tensor(part * 8))),
                k * 8 + 4 * (side == "voxels") + part,
            )
            for k in ((row == number) & (blocks.key < end)).nonzero()[:, 0].tolist()
            for part in range(4)
            if blocks.masks[k, int(side == "voxels"), part * 8 : part * 8 + 8].any()
        ]
        assert visited[int(rows.start(torch.tensor(number)))] == expected
    merges = {start: list(range(first, last)) for start, first, last in order.merges.tolist() if start >= 0}
    assert {start: sorted(found) for start, found in slots.items()} == merges
    assert sum(map(len, merges.values())) <= 20 == 2 * len(order.merges)
    # A tile touches at most the 6 · 4 parts; a block touches up to 100 · 4, cut where the slots suffice.
    assert (len(merges) > 0) == (side == "voxels")


def test_pieces_are_as_short_as_the_slots_allow(monkeypatch):
    monkeypatch.setattr(block_pairs, "_SLOTS", 6)
    # Each of both orders by itself: for the second row 64 would need 2 + 6 slots, 128 needs 3.
    length, pieces = block_pairs._pieces(torch.tensor([[64, 3, 0], [65, 384, 0]]))
    assert length.tolist() == [[64], [128]]
    assert pieces.tolist() == [[1, 1, 1], [1, 3, 1]]
    assert block_pairs._pieces(torch.tensor([[10**7] * 7] * 2))[0].tolist() == [[2**30]] * 2


def test_no_pair_at_all():
    none = torch.zeros(0, dtype=torch.int64)
    blocks = PairList(none, none, 40, 70).blocks()
    assert blocks.masks.shape == (0, 2, 32)
    order = blocks.by("pixels")
    assert order.items[order.items[:, 0] >= 0].tolist() == [[0, 0, 0, -1], [32, 0, 0, -1]]
    assert not (blocks.by("voxels").merges[:, 0] >= 0).any()


def test_share_of_the_matrix_on_traced_pairs(random_cameras):
    cameras = random_cameras(6, spread=0.3)
    pairs = trace_pairs(cameras, VoxelGrid((24, 24, 8), (9.0, 9.0, 3.5), torch.zeros(3)), (30, 40), 2)
    assert pairs.pixel_shape == (6, 30, 40)
    assert pairs.voxel_shape == (1, 24, 24, 8)
    blocks = pairs.blocks()
    # Neighbours share their blocks; runs of a row or column touch more than half as many again.
    scattered = PairList(pairs.pixel_index, pairs.voxel_index, pairs.num_pixels, pairs.num_voxels).blocks()
    assert 3 * len(blocks) < 2 * len(scattered)


def test_shape_of_other_size_is_an_error():
    none = torch.zeros(0, dtype=torch.int64)
    with pytest.raises(ShapeError, match="expected a shape of 4 elements"):
        PairList(none, none, 4, 5, pixel_shape=(1, 2, 3))


@pytest.mark.parametrize(("pixel_shape", "voxel_shape"), SHAPES)
def test_number_of_pixels_of_each_voxel(shaped_pairs, pixel_shape, voxel_shape):
    pairs = shaped_pairs(pixel_shape, voxel_shape, 0.5)
    assert torch.equal(pairs.blocks().pixels_per_voxel(), pair_mask(pairs).sum(dim=0))
