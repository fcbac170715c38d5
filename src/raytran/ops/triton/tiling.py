# SPDX-License-Identifier: Apache-2.0
"""Pixels in tiles and voxels in blocks of 32, each of four parts of 8."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor

from raytran.structs import kept_on_device

ROW = 32
"""Elements of a tile or a block: bits of a mask's word."""

PART = 8
"""Elements of a part of a tile or block: words of a part's mask."""

PARTS = ROW // PART


@dataclass(frozen=True)
class Tiling:
    """How a grid is cut into boxes of equal shape, and these into parts; boxes may reach over the far ends.

    A box's slots are numbered part by part, in a part and among parts with c fastest.

    Attributes:
        shape: ``(n, a, b, c)`` elements, numbered with c fastest; n grids one after another.
        tile: elements of a box along a, b, c; 32 in all.
        part: elements of a part along a, b, c; 8 in all.
    """

    shape: tuple[int, int, int, int]
    tile: tuple[int, int, int]
    part: tuple[int, int, int]

    @classmethod
    def of_pixels(cls, count: int, shape: tuple[int, int, int] | None) -> Tiling:
        """Cut views ``(n, h, w)`` into tiles of 4×8, or so many pixels of unknown layout into runs of 32."""
        return cls.of_run(count) if shape is None else cls((shape[0], 1, *shape[1:]), (1, 4, 8), (1, 2, 4))

    @classmethod
    def of_voxels(cls, count: int, shape: tuple[int, int, int, int] | None) -> Tiling:
        """Cut grids ``(B, X, Y, Z)`` into blocks of 2×4×4, or voxels of unknown layout into runs of 32."""
        return cls.of_run(count) if shape is None else cls(shape, (2, 4, 4), (2, 2, 2))

    @classmethod
    def of_run(cls, count: int) -> Tiling:
        """Cut so many elements into runs."""
        return cls((1, 1, 1, count), (1, 1, ROW), (1, 1, PART))

    @property
    def is_run(self) -> bool:
        """Whether boxes are runs of elements of unknown layout."""
        return self.tile == (1, 1, ROW)

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
        tile_stride, part_stride, stride = 1, PART, 1
        for axis in (3, 2, 1):
            size, step, part = self.shape[axis], self.tile[axis - 1], self.part[axis - 1]
            place, at = at % size, at // size
            tile = tile + place // step * tile_stride
            slot = slot + place % step // part * part_stride + place % part * stride
            tile_stride, part_stride, stride = (
                tile_stride * sizes[axis],
                part_stride * (step // part),
                stride * part,
            )
        return tile + at * tile_stride, slot

    def starts(self, device: torch.device) -> Tensor:
        """Return the first element of every box, and -1 behind them, ``(num_tiles + 1,)`` int32; kept."""
        return _starts(self, device=device)

    def offsets(self, device: torch.device) -> Tensor:
        """Return ``offset`` of every slot, ``(32,)`` int32; kept."""
        return _offsets(self, device=device)

    def start(self, tile: Tensor) -> Tensor:
        """Return the first element of each box."""
        at, element, stride = tile, torch.zeros_like(tile), 1
        for axis in (3, 2, 1):
            element = element + at % self.tiles[axis] * self.tile[axis - 1] * stride
            at, stride = at // self.tiles[axis], stride * self.shape[axis]
        return element + at * stride

    def offset(self, slot: Tensor) -> Tensor:
        """Return how many elements each slot lies behind its box's first element."""
        part, inner, offset, stride = slot // PART, slot % PART, torch.zeros_like(slot), 1
        for axis in (3, 2, 1):
            step, size = self.tile[axis - 1], self.part[axis - 1]
            offset = offset + (part % (step // size) * size + inner % size) * stride
            part, inner, stride = part // (step // size), inner // size, stride * self.shape[axis]
        return offset


@kept_on_device(16)
def _starts(tiling: Tiling, *, device: torch.device) -> Tensor:
    tile = torch.arange(tiling.num_tiles, device=device)
    return torch.nn.functional.pad(tiling.start(tile), (0, 1), value=-1).int()


@kept_on_device(16)
def _offsets(tiling: Tiling, *, device: torch.device) -> Tensor:
    return tiling.offset(torch.arange(ROW, device=device)).int()
