# SPDX-License-Identifier: Apache-2.0
"""Which pixels each voxel read, packed small enough for a browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from raytran.ops.pairs import PairList
from raytran.ops.sparse import row_of_pair, segment_max

MAX_PAIRS = 8_000_000
"""Pairs that are kept of a volume: about 8 MB of weights and 3 MB of places."""

_STEPS = 255


@dataclass(frozen=True)
class VoxelReads:
    """What the voxels of one volume read in the last block.

    Attributes:
        pairs: which voxel reads which pixel, of one scene.
        weight: ``(P,)`` in the order of ``pairs.by("voxels")``; those of a voxel add up to 1.
        feature_size: ``(h, w)``; pixels are numbered view-major, row-major.
    """

    pairs: PairList
    weight: Tensor
    feature_size: tuple[int, int]


class PackedReads(NamedTuple):
    """The pairs that are kept, voxel by voxel.

    Attributes:
        offsets: ``(V + 1,)`` int32; the pairs of voxel ``v`` are ``offsets[v]:offsets[v + 1]``.
        steps: ``(P',)`` int32; a voxel's first pixel, then the distance from each pixel to the next.
        weights: ``(P',)`` uint8, 255 for a voxel's strongest pixel.
        cut: pairs with a smaller ``weights`` are left out.
    """

    offsets: Tensor
    steps: Tensor
    weights: Tensor
    cut: int


def pack_reads(reads: VoxelReads, *, max_pairs: int = MAX_PAIRS) -> PackedReads:
    """Round weights to 255 steps of each voxel's strongest and leave out what rounds to nothing.

    Should more than ``max_pairs`` be left, the weakest steps go too, the same ones for every voxel; the
    strongest pixel of a voxel always stays.
    """
    order = reads.pairs.by("voxels")
    row = row_of_pair(order)
    strongest = segment_max(reads.weight, order).index_select(0, row)
    rounded = (reads.weight / strongest * _STEPS).round().to(torch.uint8)
    at_least = torch.bincount(rounded, minlength=_STEPS + 1).flip(0).cumsum(0).flip(0)
    few_enough = at_least[1:] <= max_pairs
    cut = int(few_enough.nonzero()[0]) + 1 if few_enough.any() else _STEPS
    kept = rounded >= cut
    row, pixel = row[kept], order.col_index[kept]
    offsets = torch.searchsorted(row, torch.arange(reads.pairs.num_voxels + 1), out_int32=True)
    steps = pixel.diff(prepend=pixel.new_zeros(1))
    starts = offsets[:-1][offsets.diff() > 0].long()
    steps[starts] = pixel[starts]
    return PackedReads(offsets, steps, rounded[kept], cut)
