# SPDX-License-Identifier: Apache-2.0
"""Pairs in blocks: tiles of pixels, blocks of voxels, and bit masks for each tile and block that touch.

Neighbouring pixels look through neighbouring voxels. Tiles are of 4×8 pixels, blocks of 2×4×4 voxels, 32
each. A tile and a block that touch have 32×32 bits that say which of their pairs a ray joins, kept twice, in
words of pixels' bits and in words of voxels' bits. Tiles and blocks fall into four parts of 8 (2×4 pixels,
2×2×2 voxels): a row of the kernels' work, a tile or a block, walks over the parts that it touches on the
other side. At the paper's size, 20 views of a recorded walk, 19,134 of 921,600 block pairs touch, and the
kernels compute 10.5 M scores a head along pixels and 14.1 M along voxels; 1.0 M are of pairs. Whole blocks of
4×4×4 would take 24.7 M. With both orders that is 6 MiB, at 96 views 29 MiB, where a ``PairList`` has 189 MiB.

Nothing here waits for a GPU: sizes that depend on the data are capacities, and what is unused says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from raytran.ops.triton.tiling import PART, PARTS, ROW, Tiling
from raytran.structs import TensorStruct, cached, constant, kept_on_device

_SLOTS = 512
"""Slots of scratch memory, for the pieces of long rows."""

_PIECES = [64 << power for power in range(12)] + [1 << 30]
"""Lengths of a piece to choose from: the shortest for which the slots suffice; the last cuts no row."""


class BlockOrder(NamedTuple):
    """Work items of the kernels that compute a result for each pixel tile, or for each voxel block.

    A row is a tile or a block with the parts of the other side that it touches. One with very many (a block
    near a camera) is cut into pieces. The kernels take one item each; what they find for a piece goes to a
    slot of scratch memory, and a second pass adds up each row's slots.

    All is one tensor, because the host needs longer to hand over a tensor than a GPU to read one.

    Attributes:
        numbers: int32, ``items``, ``merges`` and the parts one after another.
        num_items: I.
        num_merges: R.
    """

    numbers: Tensor
    num_items: int
    num_merges: int

    @property
    def items(self) -> Tensor:
        """``(I, 4)`` int32, longest first.

        The row's first element, -1 for an unused item; its parts ``first:last``; and the slot for the result,
        -1 where the item is the whole row.
        """
        return self.numbers[: 4 * self.num_items].view(-1, 4)

    @property
    def merges(self) -> Tensor:
        """``(R, 3)`` int32: the first element of a row that is cut, -1 if unused; its slots ``first:last``.

        A row has two at least, so that there are at most 2 · R.
        """
        return self.numbers[4 * self.num_items : 4 * self.num_items + 3 * self.num_merges].view(-1, 3)

    @property
    def part_start(self) -> Tensor:
        """``(L,)`` int32, first element of each part, row after row."""
        return self._parts[:, 0]

    @property
    def place(self) -> Tensor:
        """``(L,)`` int32, the place of each part's mask, 8 words, in ``BlockPairs.masks``."""
        return self._parts[:, 1]

    @property
    def _parts(self) -> Tensor:
        return self.numbers[4 * self.num_items + 3 * self.num_merges :].view(-1, 2)


@dataclass(frozen=True)
class BlockPairs(TensorStruct):
    """The pairs of a pixel and a voxel that a ray joins, as ``K`` pairs of a pixel tile and a voxel block.

    Attributes:
        key: ``(K,)`` int64, rising: ``tile · num_blocks + block``; ``num_tiles · num_blocks`` where unused.
        masks: ``(K, 2, 32)`` int32, zero where unused. Bit p of word v of the first, and bit v of word p of
            the second, say that a ray joins slot p of the tile and slot v of the block.
        pixels: how pixels are cut into tiles.
        voxels: how voxels are cut into blocks.
    """

    key: Tensor
    masks: Tensor
    pixels: Tiling
    voxels: Tiling

    @classmethod
    def from_index(
        cls, pixel_index: Tensor, voxel_index: Tensor, pixels: Tiling, voxels: Tiling
    ) -> BlockPairs:
        """Gather a list of pairs, each once, into blocks."""
        tile, pixel = pixels.locate(pixel_index)
        block, voxel = voxels.locate(voxel_index)
        key, place = torch.unique(tile * voxels.num_tiles + block, return_inverse=True)
        masks = torch.zeros(key.shape[0] * 2 * ROW, dtype=torch.int32, device=key.device)
        # Every bit comes once, so that adding sets bits; the last wraps around to the sign.
        one, first = torch.ones_like(pixel, dtype=torch.int32), place * 2 * ROW
        masks.scatter_add_(0, first + voxel, one << pixel.int())
        masks.scatter_add_(0, first + ROW + pixel, one << voxel.int())
        return cls(key, masks.view(-1, 2, ROW), pixels, voxels)

    def __len__(self) -> int:
        return int(self.key.shape[0])

    @property
    def num_pixels(self) -> int:
        """Pixels in all, with or without a pair."""
        return self.pixels.num_elements

    @property
    def num_voxels(self) -> int:
        """Voxels in all, with or without a pair."""
        return self.voxels.num_elements

    def index(self) -> tuple[Tensor, Tensor]:
        """Return the pixel and the voxel of every pair, ``(P,)`` int64, sorted by pixel, then by voxel."""
        bits = torch.arange(ROW, dtype=torch.int32, device=self.masks.device)[:, None]
        pair, pixel, voxel = ((self.masks[:, :1] >> bits) & 1).nonzero(as_tuple=True)
        tile, block = self.key[pair] // self.voxels.num_tiles, self.key[pair] % self.voxels.num_tiles
        pixel_index = self.pixels.start(tile) + self.pixels.offset(pixel)
        voxel_index = self.voxels.start(block) + self.voxels.offset(voxel)
        both = (pixel_index * self.num_voxels + voxel_index).sort().values
        return both // self.num_voxels, both % self.num_voxels

    def pixels_per_voxel(self) -> Tensor:
        """Return with how many pixels each voxel is paired, ``(num_voxels,)`` int64; made once and kept."""
        return cached(self, "_pixels_per_voxel", self._count_pixels)

    def _count_pixels(self) -> Tensor:
        device = self.masks.device
        number_of = _bits_of_bytes(device=device)
        bits = number_of[self.masks[:, 0].view(torch.uint8).int()].view(-1, ROW, 4).sum(dim=2)
        voxel = self.voxels.starts(device)[self._block][:, None] + self.voxels.offsets(device)
        # Slots over the edge of the grid count nothing, wherever that is added.
        voxel = voxel.clamp_(max=max(self.num_voxels - 1, 0))
        return bits.new_zeros(self.num_voxels).index_add_(0, voxel.flatten(), bits.flatten())

    def by(self, rows: Literal["pixels", "voxels"]) -> BlockOrder:
        """Return the pairs in rows, one per pixel tile or one per voxel block; made once and kept."""
        return self.orders()[0 if rows == "pixels" else 1]

    def orders(self) -> tuple[BlockOrder, BlockOrder]:
        """Return both orders, that of pixel tiles first; made once and kept."""
        return cached(self, "_orders", self._make_orders)

    @property
    def _tile(self) -> Tensor:
        return self.key // max(self.voxels.num_tiles, 1)

    @property
    def _block(self) -> Tensor:
        return self.key % max(self.voxels.num_tiles, 1)

    def _make_orders(self) -> tuple[BlockOrder, BlockOrder]:
        """Return the order of the tiles and that of the blocks.

        Both are made at once, in tensors of a row for each: launches cost more than what they compute. The
        side that has fewer tiles or blocks gets empty ones behind them.
        """
        num_rows = max(self.pixels.num_tiles, self.voxels.num_tiles)
        starts, offsets = _both_sides(self.pixels, self.voxels, num_rows, device=self.key.device)
        row = torch.stack([self._tile, self._block])
        part_start = starts.gather(1, row)[..., None] + offsets[:, None, ::PART]
        # The parts that a row does not touch, those of unused pairs among them, are sorted to the end. The
        # sort is stable, so that the order of every sum is fixed.
        untouched = (self.masks.view(-1, 2, PARTS, PART) == 0).all(dim=3).transpose(0, 1)
        row = row[..., None].expand(-1, -1, PARTS).masked_fill(untouched, num_rows)
        row[1].add_(num_rows + 1)  # blocks come behind tiles
        row, found = torch.sort(row.flatten(), stable=True)  # found: PARTS · (K · side + pair) + part
        first = torch.searchsorted(row, _count_to(2 * num_rows + 2, device=row.device), out_int32=True)
        first = first.view(2, -1)
        first[1].sub_(PARTS * len(self))
        place = torch.add(found, found // PARTS, alpha=PARTS).view(2, -1)
        place[1].sub_(PARTS * (2 * len(self) - 1))  # the second half of a pair's masks
        # Along a tile lie the parts of blocks, and the other way round.
        parts = torch.stack([part_start.flip(0).flatten()[found], place.int().flatten()], dim=1)
        items, merges = _schedule(first, starts)
        numbers = torch.cat([part.reshape(2, -1) for part in (items, merges, parts)], dim=1)
        of_tiles, of_blocks = (BlockOrder(some, items.shape[1], merges.shape[1]) for some in numbers)
        return of_tiles, of_blocks


def _schedule(offsets: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``BlockOrder.items`` and ``.merges`` of both orders, ``(2, I, 4)`` and ``(2, R, 3)``.

    Args:
        offsets: ``(2, rows + 1)`` int32, where rows begin.
        start: ``(2, rows + 1)`` int32, the first element of each, -1 behind the last.
    """
    piece, pieces = _pieces(offsets.diff())
    is_cut = pieces > 1
    counts = torch.stack([pieces, pieces * is_cut, is_cut]).cumsum(dim=2, dtype=torch.int32)
    items_before, slots_before, cuts_before = torch.nn.functional.pad(counts, (1, 0))
    # What is known of each row, and of one more behind them, which unused items and merges are of.
    next_slots, next_offsets = slots_before.roll(-1, dims=1), offsets.roll(-1, dims=1)
    ends = torch.stack([start, slots_before, next_slots, items_before, offsets, next_offsets])

    item = _count_to(start.shape[1] - 1 + _SLOTS, device=start.device)
    item = torch.minimum(item, items_before[:, -1:])
    row = torch.searchsorted(counts[0], item, right=True)
    first_element, slot, last_slot, first_item, first, end = ends.gather(2, row.expand(6, -1, -1))
    number = item - first_item
    first = torch.addcmul(first, number, piece)
    last = torch.minimum(first + piece, end)
    slot = (slot + number).masked_fill(slot == last_slot, -1)
    items = torch.stack([first_element, first, last, slot], dim=2)
    # What is behind the last row ends before it begins: unused items come last.
    longest_first = torch.argsort(last - first, dim=1, descending=True, stable=True)

    cut = _count_to(_SLOTS // 2, device=start.device)
    row = torch.searchsorted(counts[2], torch.minimum(cut, cuts_before[:, -1:]), right=True)
    merges = ends[:3].gather(2, row.expand(3, -1, -1)).permute(1, 2, 0)
    return items.gather(1, longest_first[..., None].expand(-1, -1, 4)), merges


def _pieces(lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Return the length of a piece, ``(2, 1)``, and how many each row has, for lengths ``(2, rows)``."""
    choices = constant(tuple(_PIECES), torch.int32, device=lengths.device)
    pieces = (lengths + (choices - 1)[:, None, None]) // choices[:, None, None]
    slots = pieces.masked_fill(pieces <= 1, 0).sum(dim=2)
    # The slots become fewer from choice to choice.
    choice = (slots > _SLOTS).sum(dim=0)
    chosen = pieces.gather(0, choice[:, None].expand_as(lengths)[None])[0]
    return choices.index_select(0, choice)[:, None], chosen.clamp(min=1)


@kept_on_device(16)
def _count_to(number: int, *, device: torch.device) -> Tensor:
    return torch.arange(number, dtype=torch.int32, device=device)


@kept_on_device(16)
def _both_sides(
    pixels: Tiling, voxels: Tiling, num_rows: int, *, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return ``Tiling.starts`` of both, filled up to ``(2, num_rows + 1)``, and ``.offsets``, ``(2, 32)``."""
    starts = [tiling.starts(device) for tiling in (pixels, voxels)]
    filled = [torch.nn.functional.pad(some, (0, num_rows + 1 - len(some)), value=-1) for some in starts]
    return torch.stack(filled), torch.stack([tiling.offsets(device) for tiling in (pixels, voxels)])


@kept_on_device(16)
def _bits_of_bytes(*, device: torch.device) -> Tensor:
    """Return how many bits of each byte are set, ``(256,)`` uint8."""
    byte = torch.arange(256, device=device)[:, None]
    return ((byte >> torch.arange(8, device=device)) & 1).sum(dim=1, dtype=torch.uint8)
