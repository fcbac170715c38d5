# SPDX-License-Identifier: Apache-2.0
"""Pairs in blocks: tiles of pixels, blocks of voxels, and a bit mask for each tile and block that touch.

Neighbouring pixels look through neighbouring voxels. At the paper's size, 20 views of a recorded walk, tiles
of 4×8 pixels touch blocks of 4×4×4 voxels in 2.7 % of the cases (12,538 of 460,800), and a mask of 32×64 bits
for each, 256 bytes, says which of its pairs a ray joins, 4 % of them. This is what the fused kernels run on:
dense products on tensor cores inside a block pair, nothing outside.

Nothing here waits for a GPU: sizes that depend on the data are capacities, and what is unused says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import prod
from typing import Literal, NamedTuple, TypeVar

import torch
from torch import Tensor

from raytran.types import Parcel

Made = TypeVar("Made")

PIXELS = 32
"""Pixels of a tile: bits of a mask's word."""

VOXELS = 64
"""Voxels of a block: words of a mask."""

_PIECES = 128
"""How many times longer than a piece the whole list of block pairs may be; bounds the scratch memory."""

_SHORTEST_PIECE = 32


@dataclass(frozen=True)
class Tiling:
    """How a grid is cut into boxes of equal shape; boxes at the far ends may reach over the edge.

    Attributes:
        shape: ``(n, a, b, c)`` elements, numbered with c fastest; n grids one after another.
        tile: elements of a box along a, b, c.
    """

    shape: tuple[int, int, int, int]
    tile: tuple[int, int, int]

    @classmethod
    def of_pixels(cls, count: int, shape: tuple[int, int, int] | None) -> Tiling:
        """Cut views ``(n, h, w)`` into tiles of 4×8, or so many pixels of unknown layout into runs of 32."""
        return (
            cls((1, 1, 1, count), (1, 1, PIXELS))
            if shape is None
            else cls((shape[0], 1, *shape[1:]), (1, 4, 8))
        )

    @classmethod
    def of_voxels(cls, count: int, shape: tuple[int, int, int, int] | None) -> Tiling:
        """Cut grids ``(B, X, Y, Z)`` into blocks of 4×4×4, or voxels of unknown layout into runs of 64."""
        return cls((1, 1, 1, count), (1, 1, VOXELS)) if shape is None else cls(shape, (4, 4, 4))

    @property
    def num_elements(self) -> int:
        """Elements of all grids."""
        return prod(self.shape)

    @property
    def tiles(self) -> tuple[int, int, int, int]:
        """Boxes along each axis, ``(n, a, b, c)``."""
        a, b, c = (-(-size // step) for size, step in zip(self.shape[1:], self.tile, strict=True))
        return self.shape[0], a, b, c

    @property
    def num_tiles(self) -> int:
        """Boxes of all grids."""
        return prod(self.tiles)

    def locate(self, element: Tensor) -> tuple[Tensor, Tensor]:
        """Return the box of each element and its slot in the box; both integer tensors like ``element``."""
        at, sizes = element, self.tiles
        tile, slot = torch.zeros_like(element), torch.zeros_like(element)
        tile_stride = slot_stride = 1
        for axis in (3, 2, 1):
            size, step = self.shape[axis], self.tile[axis - 1]
            place, at = at % size, at // size
            tile = tile + place // step * tile_stride
            slot = slot + place % step * slot_stride
            tile_stride, slot_stride = tile_stride * sizes[axis], slot_stride * step
        return tile + at * tile_stride, slot

    def start(self, tile: Tensor) -> Tensor:
        """Return the first element of each box."""
        at, element, stride = tile, torch.zeros_like(tile), 1
        for axis in (3, 2, 1):
            element = element + at % self.tiles[axis] * self.tile[axis - 1] * stride
            at, stride = at // self.tiles[axis], stride * self.shape[axis]
        return element + at * stride

    def offset(self, slot: Tensor) -> Tensor:
        """Return how many elements each slot lies behind its box's first element."""
        (_, b, c), (_, step_b, step_c) = self.shape[1:], self.tile
        return (slot // (step_b * step_c) * b + slot // step_c % step_b) * c + slot % step_c


class BlockOrder(NamedTuple):
    """The block pairs in rows, a row per pixel tile or per voxel block, and the work of going along them.

    A row with very many pairs (a block near a camera) is cut into pieces. The kernels take one item each;
    what they find for a piece goes to a slot of scratch memory, and a second pass adds up each row's slots.

    Attributes:
        source_start: ``(K,)`` int32, first element of the other side's box of each pair, rising in a row.
        place: ``(K,)`` int32, the place of each pair in ``BlockPairs.masks``.
        items: ``(I, 4)`` int32, longest first: the row's first element, -1 for an unused item; the pairs
            ``first:last``; and the slot for the result, -1 where the item is the whole row.
        merges: ``(R, 3)`` int32: the first element of a row that is cut, -1 if unused; its slots
            ``first:last``.
        num_slots: slots of scratch memory that may be used.
    """

    source_start: Tensor
    place: Tensor
    items: Tensor
    merges: Tensor
    num_slots: int


@dataclass(frozen=True)
class BlockPairs(Parcel):
    """The pairs of a pixel and a voxel that a ray joins, as ``K`` pairs of a pixel tile and a voxel block.

    Attributes:
        key: ``(K,)`` int64, rising: ``tile · num_blocks + block``; ``num_tiles · num_blocks`` where unused.
        masks: ``(K, 64)`` int32: bit p of word v says that a ray joins pixel p of the tile and voxel v of the
            block; zero where unused.
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
        masks = torch.zeros(key.shape[0] * VOXELS, dtype=torch.int32, device=key.device)
        # Every bit comes once, so that adding sets bits; the last wraps around to the sign.
        bit = torch.ones_like(pixel, dtype=torch.int32) << pixel.int()
        masks.scatter_add_(0, place * VOXELS + voxel, bit)
        return cls(key, masks.view(-1, VOXELS), pixels, voxels)

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
        bits = torch.arange(PIXELS, dtype=torch.int32, device=self.masks.device)[:, None]
        pair, pixel, voxel = ((self.masks[:, None, :] >> bits) & 1).nonzero(as_tuple=True)
        tile, block = self.key[pair] // self.voxels.num_tiles, self.key[pair] % self.voxels.num_tiles
        pixel_index = self.pixels.start(tile) + self.pixels.offset(pixel)
        voxel_index = self.voxels.start(block) + self.voxels.offset(voxel)
        both = (pixel_index * self.num_voxels + voxel_index).sort().values
        return both // self.num_voxels, both % self.num_voxels

    def pixels_per_voxel(self) -> Tensor:
        """Return with how many pixels each voxel is paired, ``(num_voxels,)`` int64; made once and kept."""
        return kept(self, "_pixels_per_voxel", self._count_pixels)

    def _count_pixels(self) -> Tensor:
        # Bits are added up in pairs, nibbles, bytes ("Hacker's Delight" §5-1).
        bits = self.masks.long() & 0xFFFFFFFF
        bits = bits - ((bits >> 1) & 0x55555555)
        bits = (bits & 0x33333333) + ((bits >> 2) & 0x33333333)
        bits = (((bits + (bits >> 4)) & 0x0F0F0F0F) * 0x01010101 >> 24) & 0xFF
        slot = torch.arange(VOXELS, device=bits.device)
        voxel = self.voxels.start(self._block)[:, None] + self.voxels.offset(slot)
        # Slots over the edge of the grid count nothing, wherever that is added.
        voxel = voxel.clamp_(max=max(self.num_voxels - 1, 0))
        return bits.new_zeros(self.num_voxels).index_add_(0, voxel.flatten(), bits.flatten())

    def by(self, rows: Literal["pixels", "voxels"]) -> BlockOrder:
        """Return the pairs in rows, one per pixel tile or one per voxel block; made once and kept."""
        if rows == "pixels":
            return kept(self, "_by_pixels", self._order_by_pixels)
        return kept(self, "_by_voxels", self._order_by_voxels)

    def _order_by_pixels(self) -> BlockOrder:
        place = torch.arange(self.key.shape[0], device=self.key.device)
        return self._order(self._tile, self._block, place, self.pixels, self.voxels)

    def _order_by_voxels(self) -> BlockOrder:
        # Stable, so that tiles rise within a block and the order of every sum is fixed.
        block, place = torch.sort(self._block.where(self._used, self.voxels.num_tiles), stable=True)
        return self._order(block, self._tile[place], place, self.voxels, self.pixels)

    @property
    def _used(self) -> Tensor:
        return self.key < self.pixels.num_tiles * self.voxels.num_tiles

    @property
    def _tile(self) -> Tensor:
        return self.key // max(self.voxels.num_tiles, 1)

    @property
    def _block(self) -> Tensor:
        return self.key % max(self.voxels.num_tiles, 1)

    def _order(self, row: Tensor, other: Tensor, place: Tensor, rows: Tiling, others: Tiling) -> BlockOrder:
        """Return the order of pairs sorted by ``row``; rows behind the last are of pairs not used."""
        number = torch.arange(rows.num_tiles + 1, device=row.device)
        offsets = torch.searchsorted(row, number)
        piece = max(_SHORTEST_PIECE, 1 << (-(-len(self) // _PIECES) - 1).bit_length())
        items, merges = _schedule(offsets, rows.start(number[:-1]), piece, len(self))
        return BlockOrder(others.start(other).int(), place.int(), items, merges, 2 * len(self) // piece)


def kept(parcel: Parcel, name: str, make: Callable[[], Made]) -> Made:
    """Return what ``make`` made for a parcel when it was first asked for ``name``.

    Not ``functools.cached_property``: until Python 3.12 it holds a lock, through which ``torch.compile``
    cannot pass.
    """
    if not hasattr(parcel, name):
        object.__setattr__(parcel, name, make())
    return getattr(parcel, name)


def _schedule(offsets: Tensor, start: Tensor, piece: int, num_pairs: int) -> tuple[Tensor, Tensor]:
    """Return ``BlockOrder.items`` and ``.merges`` of rows that begin at ``offsets``, cut into pieces."""
    num_rows, device = start.shape[0], start.device
    pieces = ((offsets.diff() + piece - 1) // piece).clamp(min=1)
    cut = pieces > 1
    items_before, slots_before = _before(pieces), _before(pieces * cut)

    item = torch.arange(num_rows + num_pairs // piece, device=device)
    row = torch.searchsorted(items_before[1:], item, right=True)
    used, row = row < num_rows, row.clamp(max=num_rows - 1)
    number = item - items_before[row]
    first = offsets[row] + number * piece
    last = torch.minimum(first + piece, offsets[row + 1])
    slot = (slots_before[row] + number).where(cut[row], -1)
    items = torch.stack([start[row].where(used, -1), first, last, slot], dim=1).int()
    longest_first = torch.argsort((last - first).where(used, -1), descending=True, stable=True)

    cuts_before = _before(cut.long())
    row = torch.searchsorted(cuts_before[1:], torch.arange(num_pairs // piece, device=device), right=True)
    used, row = row < num_rows, row.clamp(max=num_rows - 1)
    merges = torch.stack([start[row].where(used, -1), slots_before[row], slots_before[row + 1]], dim=1).int()
    return items[longest_first], merges


def _before(counts: Tensor) -> Tensor:
    """Return how many there are before each, and in all, ``(n + 1,)``."""
    return torch.nn.functional.pad(counts.cumsum(0), (1, 0))
