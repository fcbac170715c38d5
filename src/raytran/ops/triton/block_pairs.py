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
from raytran.structs import TensorStruct, cached

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

    @classmethod
    def of(cls, part_start: Tensor, place: Tensor, items: Tensor, merges: Tensor) -> BlockOrder:
        """Return the order of these; see the properties."""
        parts = torch.stack([part_start, place], dim=1)
        flat = [part.flatten().int() for part in (items, merges, parts)]
        return cls(torch.cat(flat), items.shape[0], merges.shape[0])

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
        # Bits are added up in pairs, nibbles, bytes ("Hacker's Delight" §5-1).
        bits = self.masks[:, 0].long() & 0xFFFFFFFF
        bits = bits - ((bits >> 1) & 0x55555555)
        bits = (bits & 0x33333333) + ((bits >> 2) & 0x33333333)
        bits = (((bits + (bits >> 4)) & 0x0F0F0F0F) * 0x01010101 >> 24) & 0xFF
        slot = torch.arange(ROW, device=bits.device)
        voxel = self.voxels.start(self._block)[:, None] + self.voxels.offset(slot)
        # Slots over the edge of the grid count nothing, wherever that is added.
        voxel = voxel.clamp_(max=max(self.num_voxels - 1, 0))
        return bits.new_zeros(self.num_voxels).index_add_(0, voxel.flatten(), bits.flatten())

    def by(self, rows: Literal["pixels", "voxels"]) -> BlockOrder:
        """Return the pairs in rows, one per pixel tile or one per voxel block; made once and kept."""
        if rows == "pixels":
            return cached(self, "_by_pixels", self._order_by_pixels)
        return cached(self, "_by_voxels", self._order_by_voxels)

    def orders(self) -> tuple[BlockOrder, BlockOrder]:
        """Return both orders, that of pixel tiles first."""
        return self.by("pixels"), self.by("voxels")

    def _order_by_pixels(self) -> BlockOrder:
        return self._order(0, self._tile, self._block, self.pixels, self.voxels)

    def _order_by_voxels(self) -> BlockOrder:
        return self._order(1, self._block, self._tile, self.voxels, self.pixels)

    @property
    def _tile(self) -> Tensor:
        return self.key // max(self.voxels.num_tiles, 1)

    @property
    def _block(self) -> Tensor:
        return self.key % max(self.voxels.num_tiles, 1)

    def _order(self, side: int, row: Tensor, other: Tensor, rows: Tiling, others: Tiling) -> BlockOrder:
        """Return the order by ``row`` (K,), whose masks are the first or second of each block pair."""
        # The parts that a row does not touch, those of unused pairs among them, are sorted to the end. The
        # sort is stable, so that the order of every sum is fixed.
        touched = (self.masks[:, side].view(-1, PARTS, PART) != 0).any(dim=2)
        row, found = torch.sort(row[:, None].where(touched, rows.num_tiles).flatten(), stable=True)
        pair, part = found // PARTS, found % PARTS
        number = torch.arange(rows.num_tiles + 1, device=row.device)
        offsets = torch.searchsorted(row, number)
        items, merges = _schedule(offsets, rows.start(number[:-1]))
        part_start = others.start(other)[pair] + others.offset(part * PART)
        place = (pair * 2 + side) * PARTS + part
        return BlockOrder.of(part_start, place, items, merges)


def _schedule(offsets: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``BlockOrder.items`` and ``.merges`` of rows that begin at ``offsets``."""
    num_rows, device, lengths = start.shape[0], start.device, offsets.diff()
    piece = _piece(lengths)
    pieces = ((lengths + piece - 1) // piece).clamp(min=1)
    cut = pieces > 1
    items_before, slots_before = _before(pieces), _before(pieces * cut)

    item = torch.arange(num_rows + _SLOTS, device=device)
    row = torch.searchsorted(items_before[1:], item, right=True)
    used, row = row < num_rows, row.clamp(max=num_rows - 1)
    number = item - items_before[row]
    first = offsets[row] + number * piece
    last = torch.minimum(first + piece, offsets[row + 1])
    slot = (slots_before[row] + number).where(cut[row], -1)
    items = torch.stack([start[row].where(used, -1), first, last, slot], dim=1)
    longest_first = torch.argsort((last - first).where(used, -1), descending=True, stable=True)

    cuts_before = _before(cut.long())
    row = torch.searchsorted(cuts_before[1:], torch.arange(_SLOTS // 2, device=device), right=True)
    used, row = row < num_rows, row.clamp(max=num_rows - 1)
    merges = torch.stack([start[row].where(used, -1), slots_before[row], slots_before[row + 1]], dim=1)
    return items[longest_first], merges


def _piece(lengths: Tensor) -> Tensor:
    """Return the length of a piece, ``()``, for rows of some lengths."""
    # Made on the device: to bring the list there would make the host wait.
    choices = torch.stack([lengths.new_full((), piece) for piece in _PIECES])
    pieces = (lengths + choices[:, None] - 1) // choices[:, None]
    slots = pieces.where(pieces > 1, 0).sum(dim=1)
    return choices[(slots <= _SLOTS).int().argmax()]


def _before(counts: Tensor) -> Tensor:
    """Return how many there are before each, and in all, ``(n + 1,)``."""
    return torch.nn.functional.pad(counts.cumsum(0), (1, 0))
