# SPDX-License-Identifier: Apache-2.0
"""The first voxel features V⁰: the mean of the pixel features whose rays pass a voxel (RayTran §3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from raytran.errors import check_shape
from raytran.geometry.double import place_with_double
from raytran.ops.pairs import PairList, PairOrder, Pairs, pairs_for
from raytran.ops.sparse import sparse_product


def splat_features(features: Tensor, pairs: Pairs) -> tuple[Tensor, Tensor]:
    """Average over each voxel the features of the pixels paired with it.

    Half-precision input is summed in float32.

    Args:
        features: ``(num_pixels, C)``.
        pairs: which pixel sees which voxel.

    Returns:
        ``(num_voxels, C)`` in the dtype of ``features``, zeros for a voxel with no pair; and whether it has
        one, ``(num_voxels,)`` bool.

    Raises:
        ShapeError: the number of pixels is not that of ``pairs``.
    """
    if features.ndim != 2 or features.shape[0] != pairs.num_pixels:
        check_shape(features, f"{pairs.num_pixels} C", "features")
    # The kernel takes as many channels together as it can: any number fits.
    pairs = pairs_for(pairs, features.device, features.dtype, channels=1)
    if not isinstance(pairs, PairList):
        # CPU installations of torch lack Triton: its module is imported only where it runs.
        from raytran.ops.triton.sum import block_sum

        count = pairs.pixels_per_voxel()
        mean = block_sum(features, pairs) / count.clamp(min=1)[:, None]
        return mean.to(features.dtype), count > 0
    dtype = torch.promote_types(features.dtype, torch.float32)
    by_voxel, by_pixel = pairs.orders("voxels")
    place = place_with_double(features.device)
    with torch.autocast(place.type, enabled=False):
        mean = _mean(features.to(place, dtype), list(by_voxel), list(by_pixel))
    is_seen = by_voxel.row_offsets.diff() > 0
    return mean.to(features.device, features.dtype), is_seen.to(features.device)


def splat_in_chunks(features: Sequence[Tensor], pairs: Sequence[Pairs]) -> tuple[Tensor, Tensor]:
    """Return ``splat_features`` of pixels that come in chunks; several chunks have no gradient.

    Args:
        features: of each chunk of pixels ``(num_pixels, C)``.
        pairs: of each chunk, with the same voxels.

    Raises:
        ShapeError: a number of pixels is not that of its ``pairs``.
    """
    if len(features) == 1:
        return splat_features(features[0], pairs[0])
    dtype = torch.promote_types(features[0].dtype, torch.float32)
    total = features[0].new_zeros((pairs[0].num_voxels, features[0].shape[1]), dtype=dtype)
    count = total.new_zeros(len(total), dtype=torch.int64)
    with torch.no_grad():
        for chunk, of_chunk in zip(features, pairs, strict=True):
            mean, _ = splat_features(chunk, of_chunk)
            pixels_per_voxel = of_chunk.pixels_per_voxel().to(total.device)
            total += mean.to(dtype) * pixels_per_voxel[:, None]
            count += pixels_per_voxel
    mean = total / count.clamp(min=1)[:, None]
    return mean.to(features[0].dtype), count > 0


@torch.library.custom_op("raytran::pair_mean", mutates_args=())
def _mean(features: Tensor, by_voxel: Sequence[Tensor], by_pixel: Sequence[Tensor]) -> Tensor:
    """Return the mean ``(num_voxels, C)`` of ``features`` over the pairs of each voxel.

    Orders are ``PairOrder``'s tensors; that of the pixels serves the backward pass.
    """
    order = PairOrder(*by_voxel)
    ones = features.new_ones(order.col_index.shape)
    return sparse_product(ones, features, order) / _counts(order, features)


@_mean.register_fake
def _(features: Tensor, by_voxel: Sequence[Tensor], by_pixel: Sequence[Tensor]) -> Tensor:
    return features.new_empty(by_voxel[0].shape[0] - 1, features.shape[1])


@torch.library.custom_op("raytran::pair_mean_backward", mutates_args=())
def _mean_backward(grad: Tensor, by_voxel: Sequence[Tensor], by_pixel: Sequence[Tensor]) -> Tensor:
    """Return the gradient ``(num_pixels, C)`` of ``features``.

    An operator of its own: ``torch.compile`` does not pass through products of sparse matrices.
    """
    of_voxel, order = PairOrder(*by_voxel), PairOrder(*by_pixel)
    ones = grad.new_ones(order.col_index.shape)
    return sparse_product(ones, grad / _counts(of_voxel, grad), order)


@_mean_backward.register_fake
def _(grad: Tensor, by_voxel: Sequence[Tensor], by_pixel: Sequence[Tensor]) -> Tensor:
    return grad.new_empty(by_pixel[0].shape[0] - 1, grad.shape[1])


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    _, by_voxel, by_pixel = inputs
    ctx.save_for_backward(*by_voxel, *by_pixel)


def _gradient(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    saved = list(ctx.saved_tensors)
    with torch.autocast(grad.device.type, enabled=False):
        back = _mean_backward(grad, saved[:3], saved[3:])
    return back, [None] * 3, [None] * 3


_mean.register_autograd(_gradient, setup_context=_keep)


def _counts(order: PairOrder, like: Tensor) -> Tensor:
    """Return the number of pairs of each row, at least one, ``(rows, 1)``."""
    return order.row_offsets.diff().clamp_(min=1).to(like.dtype)[:, None]
