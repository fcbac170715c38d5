# SPDX-License-Identifier: Apache-2.0
"""The pixel-voxel pairs that a ray joins (RayTran §3.1), and what computes with them.

On a GPU with Triton fused kernels take the pairs in blocks (``ops.triton``). Elsewhere products of
``torch.sparse`` take them as a list, in two orders.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from math import prod
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor

from raytran.errors import ShapeError, check_shape
from raytran.ops.triton.block_pairs import BlockPairs
from raytran.ops.triton.tiling import Tiling
from raytran.structs import TensorStruct, cached

Side = Literal["pixels", "voxels"]

MOST_CHANNELS = {torch.float16: 128, torch.bfloat16: 128, torch.float32: 64}
"""Channels of a head up to which the fused kernels fit into a GPU's registers, by the dtype of the inputs."""

_log = logging.getLogger(__name__)


class PairOrder(NamedTuple):
    """The pairs as a sparse matrix of compressed rows (CSR); a row is a pixel or a voxel.

    Attributes:
        row_offsets: ``(rows + 1,)`` int32; the pairs of row ``r`` are ``row_offsets[r]:row_offsets[r + 1]``.
        col_index: ``(P,)`` int32, the other side of each pair, rising within a row.
        permutation: ``(P,)`` int64, the place of each pair in the order by the other side:
            ``values[permutation]`` brings values from that order into this one.
    """

    row_offsets: Tensor
    col_index: Tensor
    permutation: Tensor


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
    # No field: a copy on another device makes its own orders.
    _orders: ClassVar[dict[Side, PairOrder]]

    def __post_init__(self) -> None:
        object.__setattr__(self, "_orders", {})
        if self.pixel_index.ndim != 1:
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
        if rows not in self._orders:
            if rows not in ("pixels", "voxels"):
                raise ValueError(f"rows must be 'pixels' or 'voxels', got {rows!r}")
            self._orders[rows] = self._order_by_pixels() if rows == "pixels" else self._order_by_voxels()
        return self._orders[rows]

    def orders(self, rows: Side = "pixels") -> tuple[PairOrder, PairOrder]:
        """Return both orders, that of ``rows`` first."""
        return self.by(rows), self.by("voxels" if rows == "pixels" else "pixels")

    def pixels_per_voxel(self) -> Tensor:
        """Return with how many pixels each voxel is paired, ``(num_voxels,)`` int32."""
        return self.by("voxels").row_offsets.diff()

    def blocks(self) -> BlockPairs:
        """Return the pairs as masks of pixel tiles and voxel blocks; made once and kept."""
        return cached(self, "_blocks", self._gather_blocks)

    def _gather_blocks(self) -> BlockPairs:
        pixels = Tiling.of_pixels(self.num_pixels, self.pixel_shape)
        voxels = Tiling.of_voxels(self.num_voxels, self.voxel_shape)
        return BlockPairs.from_index(self.pixel_index, self.voxel_index, pixels, voxels)

    def _order_by_pixels(self) -> PairOrder:
        place = self.by("voxels").permutation
        permutation = torch.empty_like(place)
        permutation[place] = torch.arange(place.shape[0], device=place.device)
        return PairOrder(_offsets(self.pixel_index, self.num_pixels), self.voxel_index.int(), permutation)

    def _order_by_voxels(self) -> PairOrder:
        # Stable, so that pixels rise within a voxel and the order of every sum is fixed.
        voxel, place = torch.sort(self.voxel_index, stable=True)
        return PairOrder(_offsets(voxel, self.num_voxels), self.pixel_index[place].int(), place)


Pairs = PairList | BlockPairs
"""The pixel-voxel pairs of some views, in either form."""


def interpreted() -> bool:
    """Return whether Triton's kernels run in its interpreter: on any device, slowly, to be tested."""
    return os.environ.get("TRITON_INTERPRET") == "1"


def why_no_kernels(device: torch.device) -> str | None:
    """Say why the fused kernels do not run on a device, None where they do."""
    if device.type != "cuda":
        return f"tensors are on the {device.type.upper()}"
    return None if find_spec("triton") is not None else "Triton is not installed"


def pairs_for(pairs: Pairs, device: torch.device, dtype: torch.dtype, channels: int) -> Pairs:
    """Return the pairs in blocks for the fused kernels; where these do not run, say once why, as a list.

    Args:
        pairs: the pairs; block pairs on a CPU ask for Triton's interpreter, if that is switched on.
        device: of the features.
        dtype: of the features.
        channels: of each head.
    """
    reason = None if interpreted() and isinstance(pairs, BlockPairs) else why_no_kernels(device)
    if isinstance(pairs, PairList) and not pairs.fused:
        reason = "the pairs ask for it"
    elif reason is None and channels > MOST_CHANNELS.get(dtype, 0):
        reason = f"heads have {channels} channels in {dtype}"
    if reason is None:
        return pairs.blocks() if isinstance(pairs, PairList) else pairs
    if not torch.compiler.is_compiling():
        _log_once(logging.WARNING if device.type == "cuda" else logging.DEBUG, reason)
    return listed(pairs)


def listed(pairs: Pairs) -> PairList:
    """Return the pairs as a list; made once and kept."""
    if isinstance(pairs, PairList):
        return pairs
    return cached(pairs, "_listed", lambda: PairList.from_blocks(pairs))


@cache
def _log_once(level: int, reason: str) -> None:
    _log.log(level, "pixels and voxels are joined by torch.sparse and not in fused kernels: %s", reason)


def _offsets(row_index: Tensor, num_rows: int) -> Tensor:
    """Return where each row begins in a list sorted by row, ``(num_rows + 1,)`` int32."""
    rows = torch.arange(num_rows + 1, device=row_index.device)
    return torch.searchsorted(row_index, rows, out_int32=True)
