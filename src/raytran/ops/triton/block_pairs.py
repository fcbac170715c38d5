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
        device = self.masks.device
        number_of = _bits_of_bytes(device=device)
        bits = number_of[self.masks[:, 0].view(torch.uint8).int()].view(-1, ROW, 4).sum(dim=2)
        voxel = self.voxels.starts(device)[self._block][:, None] + self.voxels.offsets(device)
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
        device = row.device
        untouched = (self.masks[:, side].view(-1, PARTS, PART) == 0).all(dim=2)
        row = row[:, None].expand(-1, PARTS).masked_fill(untouched, rows.num_tiles)
        row, found = torch.sort(row.flatten(), stable=True)  # found: PARTS · pair + part
        offsets = torch.searchsorted(row, _count_to(rows.num_tiles + 1, device=device), out_int32=True)
        part_start = others.starts(device)[other][:, None] + others.offsets(device)[::PART]
        place = torch.add(found, found // PARTS, alpha=PARTS) + side * PARTS
        return BlockOrder.of(
            part_start.flatten()[found], place.int(), *_schedule(offsets, rows.starts(device))
        )


def _schedule(offsets: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``BlockOrder.items`` and ``.merges``.

    Args:
        offsets: ``(rows + 1,)`` int32, where rows begin.
        start: ``(rows + 1,)`` int32, the first element of each, -1 behind the last.
    """
    piece, pieces = _pieces(offsets.diff())
    is_cut = pieces > 1
    counts = torch.stack([pieces, pieces * is_cut, is_cut]).cumsum(dim=1, dtype=torch.int32)
    items_before, slots_before, cuts_before = torch.nn.functional.pad(counts, (1, 0))
    # What is known of each row, and of one more behind them, which unused items and merges are of.
    ends = torch.stack([start, slots_before, slots_before.roll(-1), items_before, offsets, offsets.roll(-1)])

    item = _count_to(start.shape[0] - 1 + _SLOTS, device=start.device)
    item = torch.minimum(item, items_before[-1])
    row = torch.searchsorted(items_before[1:], item, right=True)
    first_element, slot, last_slot, first_item, first, end = ends.index_select(1, row)
    number = item - first_item
    first = torch.addcmul(first, number, piece)
    last = torch.minimum(first + piece, end)
    slot = (slot + number).masked_fill(slot == last_slot, -1)
    items = torch.stack([first_element, first, last, slot], dim=1)
    # What is behind the last row ends before it begins: unused items come last.
    longest_first = torch.argsort(last - first, descending=True, stable=True)

    row = torch.searchsorted(cuts_before[1:], _count_to(_SLOTS // 2, device=start.device), right=True)
    return items[longest_first], ends[:3].index_select(1, row).T.contiguous()


def _pieces(lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Return the length of a piece, ``(1,)``, and how many pieces each row has, for rows of some lengths."""
    choices = constant(tuple(_PIECES), torch.int32, device=lengths.device)
    pieces = (lengths + (choices - 1)[:, None]) // choices[:, None]
    slots = pieces.masked_fill(pieces <= 1, 0).sum(dim=1)
    # The slots become fewer from choice to choice.
    choice = (slots > _SLOTS).sum(dim=0, keepdim=True)
    return choices.index_select(0, choice), pieces.index_select(0, choice)[0].clamp(min=1)


@kept_on_device(16)
def _count_to(number: int, *, device: torch.device) -> Tensor:
    return torch.arange(number, dtype=torch.int32, device=device)


@kept_on_device(16)
def _bits_of_bytes(*, device: torch.device) -> Tensor:
    """Return how many bits of each byte are set, ``(256,)`` uint8."""
    byte = torch.arange(256, device=device)[:, None]
    return ((byte >> torch.arange(8, device=device)) & 1).sum(dim=1, dtype=torch.uint8)
