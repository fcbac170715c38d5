# SPDX-License-Identifier: Apache-2.0
"""The list of pixel-voxel pairs that a ray joins, in both orders (RayTran §3.1)."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from raytran.errors import ShapeError, check_shape
from raytran.ops.triton.block_pairs import BlockPairs, kept
from raytran.ops.triton.tiling import Tiling
from raytran.structs import TensorStruct

Side = Literal["pixels", "voxels"]


class PairOrder(NamedTuple):
    """The pairs as a sparse matrix of compressed rows (CSR); a row is a pixel or a voxel.

    Attributes:
        row_offsets: ``(rows + 1,)`` int32; the pairs of row ``r`` are ``row_offsets[r]:row_offsets[r + 1]``.
        col_index: ``(P,)`` int32, the other side of each pair, rising within a row.
        turn: ``(P,)`` int64, the place of each pair in the order by the other side: ``values[turn]`` brings
            values from that order into this one.
    """

    row_offsets: Tensor
    col_index: Tensor
    turn: Tensor


@dataclass(frozen=True)
class PairList(TensorStruct):
    """The ``P`` pairs of a pixel and a voxel that a ray joins, each once, sorted by pixel, then by voxel.

    "Pixel" is the paper's word for a cell of the feature map. In a batch, pixels are numbered scene-major,
    then view-major, row-major; voxels scene-major, then x-major, z fastest.

    Attributes:
        pixel_index: ``(P,)`` int64.
        voxel_index: ``(P,)`` int64.
        num_pixels: pixels in all, with or without a pair.
        num_voxels: voxels in all, with or without a pair.
        pixel_shape: ``(views, h, w)`` if known; makes square tiles of ``blocks()``.
        voxel_shape: ``(B, X, Y, Z)`` if known; makes cubic blocks.
        fused: whether the fused kernels may take the pairs; False leaves them to ``torch.sparse`` everywhere.

    Raises:
        ShapeError: the indices are not two vectors of one length, or a shape is not of so many elements.
    """

    pixel_index: Tensor
    voxel_index: Tensor
    num_pixels: int
    num_voxels: int
    pixel_shape: tuple[int, int, int] | None = None
    voxel_shape: tuple[int, int, int, int] | None = None
    fused: bool = True

    def __post_init__(self) -> None:
        check_shape(self.pixel_index, "P", "pixel_index")
        if self.pixel_index.shape != self.voxel_index.shape:
            raise ShapeError(
                "expected as many pixels as voxels, got "
                f"{tuple(self.pixel_index.shape)} and {tuple(self.voxel_index.shape)}"
            )
        for shape, count in ((self.pixel_shape, self.num_pixels), (self.voxel_shape, self.num_voxels)):
            if shape is not None and prod(shape) != count:
                raise ShapeError(f"expected a shape of {count} elements, got {shape}")

    @classmethod
    def from_blocks(cls, blocks: BlockPairs) -> PairList:
        """List the pairs that are joined in ``blocks``."""
        return cls(*blocks.index(), blocks.num_pixels, blocks.num_voxels)

    def __len__(self) -> int:
        return int(self.pixel_index.shape[0])

    def by(self, rows: Side) -> PairOrder:
        """Return the pairs as compressed rows, one per pixel or one per voxel; made once and kept."""
        if rows == "pixels":
            return kept(self, "_by_pixels", self._order_by_pixels)
        if rows == "voxels":
            return kept(self, "_by_voxels", self._order_by_voxels)
        raise ValueError(f"rows must be 'pixels' or 'voxels', got {rows!r}")

    def pixels_per_voxel(self) -> Tensor:
        """Return with how many pixels each voxel is paired, ``(num_voxels,)`` int32."""
        return self.by("voxels").row_offsets.diff()

    def blocks(self) -> BlockPairs:
        """Return the pairs as masks of pixel tiles and voxel blocks; made once and kept."""
        return kept(self, "_blocks", self._gather_blocks)

    def _gather_blocks(self) -> BlockPairs:
        pixels = Tiling.of_pixels(self.num_pixels, self.pixel_shape)
        voxels = Tiling.of_voxels(self.num_voxels, self.voxel_shape)
        return BlockPairs.from_index(self.pixel_index, self.voxel_index, pixels, voxels)

    def _order_by_pixels(self) -> PairOrder:
        place = self.by("voxels").turn
        turn = torch.empty_like(place)
        turn[place] = torch.arange(place.shape[0], device=place.device)
        return PairOrder(_offsets(self.pixel_index, self.num_pixels), self.voxel_index.int(), turn)

    def _order_by_voxels(self) -> PairOrder:
        # Stable, so that pixels rise within a voxel and the order of every sum is fixed.
        voxel, place = torch.sort(self.voxel_index, stable=True)
        return PairOrder(_offsets(voxel, self.num_voxels), self.pixel_index[place].int(), place)


def _offsets(row_index: Tensor, num_rows: int) -> Tensor:
    """Return where each row begins in a list sorted by row, ``(num_rows + 1,)`` int32."""
    rows = torch.arange(num_rows + 1, device=row_index.device)
    return torch.searchsorted(row_index, rows, out_int32=True)
