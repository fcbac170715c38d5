# SPDX-License-Identifier: Apache-2.0
"""The list of pixel-voxel pairs that a ray joins, in both orders (RayTran §3.1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from raytran.errors import ShapeError, check_shape
from raytran.parcel import Parcel

Side = Literal["pixels", "voxels"]


class PairOrder(NamedTuple):
    """The pairs as a sparse matrix of compressed rows (CSR); a row is a pixel or a voxel.

    Attributes:
        row_offsets: ``(rows + 1,)`` int32; the pairs of row ``r`` are ``row_offsets[r]:row_offsets[r + 1]``.
        col_index: ``(P,)`` int32, the other side of each pair, rising within a row.
        permutation: ``(P,)`` int64, the place of each pair in ``PairList.pixel_index``.
    """

    row_offsets: Tensor
    col_index: Tensor
    permutation: Tensor


@dataclass(frozen=True)
class PairList(Parcel):
    """The ``P`` pairs of a pixel and a voxel that a ray joins, each once, sorted by pixel, then by voxel.

    "Pixel" is the paper's word for a cell of the feature map. In a batch, pixels are numbered scene-major,
    then view-major, row-major; voxels scene-major, then x-major, z fastest.

    Attributes:
        pixel_index: ``(P,)`` int64.
        voxel_index: ``(P,)`` int64.
        num_pixels: pixels in all, with or without a pair.
        num_voxels: voxels in all, with or without a pair.

    Raises:
        ShapeError: the indices are not two vectors of one length.
    """

    pixel_index: Tensor
    voxel_index: Tensor
    num_pixels: int
    num_voxels: int

    def __post_init__(self) -> None:
        check_shape(self.pixel_index, "P", "pixel_index")
        if self.pixel_index.shape != self.voxel_index.shape:
            raise ShapeError(
                "expected as many pixels as voxels, got "
                f"{tuple(self.pixel_index.shape)} and {tuple(self.voxel_index.shape)}"
            )

    def __len__(self) -> int:
        return int(self.pixel_index.shape[0])

    def by(self, rows: Side) -> PairOrder:
        """Return the pairs as compressed rows, one per pixel or one per voxel; made once and kept."""
        if rows == "pixels":
            return self._by_pixels
        if rows == "voxels":
            return self._by_voxels
        raise ValueError(f"rows must be 'pixels' or 'voxels', got {rows!r}")

    @cached_property
    def _by_pixels(self) -> PairOrder:
        place = torch.arange(len(self), device=self.pixel_index.device)
        return PairOrder(_offsets(self.pixel_index, self.num_pixels), self.voxel_index.int(), place)

    @cached_property
    def _by_voxels(self) -> PairOrder:
        # Stable, so that pixels rise within a voxel and the order of every sum is fixed.
        voxel, place = torch.sort(self.voxel_index, stable=True)
        return PairOrder(_offsets(voxel, self.num_voxels), self.pixel_index[place].int(), place)


def _offsets(row_index: Tensor, num_rows: int) -> Tensor:
    """Return where each row begins in a list sorted by row, ``(num_rows + 1,)`` int32."""
    rows = torch.arange(num_rows + 1, device=row_index.device)
    return torch.searchsorted(row_index, rows, out_int32=True)
