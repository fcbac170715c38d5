# SPDX-License-Identifier: Apache-2.0
"""Which pixels each voxel reads: the weights inside the last block's ray-traced attention (RayTran §3.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.errors import check_shape
from raytran.ops.pairs import PairList
from raytran.ops.sparse import row_of_pair, sampled_product, segment_max, segment_sum

MAX_PAIRS = 8_000_000
"""Pairs that are stored of a volume: about 8 MB of weights and 3 MB of pixel numbers, compressed."""

_STEPS = 255


class ReadPixels(NamedTuple):
    """The pixels that one voxel read.

    Attributes:
        view: ``(n,)`` number of each pixel's view among those of the volume.
        row: ``(n,)`` row in the feature map.
        column: ``(n,)`` column in the feature map.
        weight: ``(n,)`` attention, which adds up to 1.
        feature_size: ``(h, w)`` of the feature map.
    """

    view: NDArray[np.int64]
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    weight: NDArray[np.float64]
    feature_size: tuple[int, int]


@dataclass(frozen=True)
class VoxelReads:
    """The pixels that each voxel of one volume read, as compressed rows (CSR), small enough for a file.

    Attributes:
        offsets: ``(V + 1,)`` int32; the pairs of voxel ``v`` are ``offsets[v]:offsets[v + 1]``.
        steps: ``(P,)`` int32; a voxel's first pixel, then the distance from each pixel to the next. Pixels
            are cells of the feature maps, numbered view-major, row-major.
        weights: ``(P,)`` uint8, 255 for a voxel's strongest pixel.
        feature_size: ``(h, w)`` of a feature map.
    """

    offsets: NDArray[np.int32]
    steps: NDArray[np.int32]
    weights: NDArray[np.uint8]
    feature_size: tuple[int, int]

    def of_voxel(self, voxel: int) -> ReadPixels:
        """Return what one voxel read; nothing if no ray passes through it."""
        pairs = slice(int(self.offsets[voxel]), int(self.offsets[voxel + 1]))
        pixel = self.steps[pairs].astype(np.int64).cumsum()
        weight = self.weights[pairs].astype(np.float64)
        height, width = self.feature_size
        view, cell = np.divmod(pixel, height * width)
        share = weight / max(weight.sum(), 1.0)
        return ReadPixels(view, cell // width, cell % width, share, self.feature_size)


@torch.no_grad()
def attention_weights(query: Tensor, key: Tensor, pairs: PairList) -> Tensor:
    """Return the attention of each voxel to each pixel that a ray joins it with, mean over the heads.

    These are the weights by which ``ray_attention(..., direction="pixels_to_voxels")`` adds up values. That
    operator never stores all of them; here they are, P numbers in float32.

    Args:
        query: ``(num_voxels, H, D)``.
        key: ``(num_pixels, H, D)``.
        pairs: which voxel reads which pixel.

    Returns:
        ``(P,)`` in the order of ``pairs.by("voxels")``; those of a voxel add up to 1.

    Raises:
        ShapeError: the numbers of voxels or pixels are not those of ``pairs``.
    """
    check_shape(query, f"{pairs.num_voxels} H D", "query")
    check_shape(key, f"{pairs.num_pixels} {query.shape[1]} {query.shape[2]}", "key")
    order = pairs.by("voxels")
    row = row_of_pair(order)
    mean = query.new_zeros(order.col_index.shape, dtype=torch.float32)
    for head in range(query.shape[1]):
        of_voxel = query[:, head].float() * query.shape[2] ** -0.5
        score = sampled_product(of_voxel, key[:, head].float().contiguous(), order)
        weight = score.sub_(segment_max(score, order).index_select(0, row)).exp_()
        mean += weight.div_(segment_sum(weight, order).index_select(0, row))
    return mean.div_(query.shape[1])


def pack_reads(
    weight: Tensor, pairs: PairList, feature_size: tuple[int, int], *, max_pairs: int = MAX_PAIRS
) -> VoxelReads:
    """Round weights to 255 steps of each voxel's strongest and leave out what rounds to nothing.

    Should more than ``max_pairs`` remain, the weakest steps go too, the same ones for every voxel; the
    strongest pixel of a voxel always stays.

    Args:
        weight: ``(P,)`` in the order of ``pairs.by("voxels")``, as ``attention_weights`` returns it.
        pairs: of one scene, on the CPU.
        feature_size: ``(h, w)``.
        max_pairs: most pairs to store.
    """
    order = pairs.by("voxels")
    row = row_of_pair(order)
    strongest = segment_max(weight, order).index_select(0, row)
    rounded = (weight / strongest * _STEPS).round().to(torch.uint8)
    # How many pairs have at least each step: the lowest step that few enough pairs reach is the threshold.
    at_least = torch.bincount(rounded, minlength=_STEPS + 1).flip(0).cumsum(0).flip(0)
    few_enough = at_least[1:] <= max_pairs
    threshold = int(few_enough.nonzero()[0]) + 1 if few_enough.any() else _STEPS
    stored = rounded >= threshold
    row, pixel = row[stored], order.col_index[stored]
    offsets = torch.searchsorted(row, torch.arange(pairs.num_voxels + 1), out_int32=True)
    # Pixels rise within a voxel, so that their distances are small and compress well.
    steps = pixel.diff(prepend=pixel.new_zeros(1))
    starts = offsets[:-1][offsets.diff() > 0].long()
    steps[starts] = pixel[starts]
    return VoxelReads(offsets.numpy(), steps.numpy(), rounded[stored].numpy(), feature_size)
