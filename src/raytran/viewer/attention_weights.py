# SPDX-License-Identifier: Apache-2.0
"""How much each voxel reads from each pixel: the weights inside ray-traced attention, to be looked at."""

from __future__ import annotations

import torch
from torch import Tensor

from raytran.errors import check_shape
from raytran.ops.pairs import PairList
from raytran.ops.sparse import row_of_pair, sampled_product, segment_max, segment_sum


@torch.no_grad()
def attention_weights(query: Tensor, key: Tensor, pairs: PairList) -> Tensor:
    """Return the attention of each voxel to each pixel that a ray joins it with, mean over the heads.

    These are the weights by which ``ray_attention(..., direction="pixels_to_voxels")`` adds up values. They
    are never all kept there; here they are, P numbers in float32.

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
