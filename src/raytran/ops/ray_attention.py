# SPDX-License-Identifier: Apache-2.0
"""Ray-traced sparse attention between the pixels and voxels that a ray joins (RayTran §3.1).

On a GPU with Triton it runs in fused kernels over blocks of pairs (``ops.triton``), elsewhere by products of
torch's sparse matrices over the list of pairs (``ops.sparse``). Neither makes the matrix of
all scores, and the same input gives the same bits.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import log
from typing import Literal

import torch
from torch import Tensor

from raytran.errors import check_shape
from raytran.geometry.double import place_with_double
from raytran.ops.pairs import PairList, Pairs, pairs_for
from raytran.ops.sparse import pair_attention

Direction = Literal["pixels_to_voxels", "voxels_to_pixels"]


def ray_attention(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    pairs: Pairs,
    direction: Direction = "pixels_to_voxels",
) -> Tensor:
    """Let each target attend to the sources that a ray joins it with.

    ``out[t] = Σ_s softmax_s(query[t]·key[s] / √D) value[s]`` over the sources s paired with t, in each head.
    Inputs of different dtypes are brought to their common one. The fused kernels multiply in that dtype and
    sum in float32; elsewhere half precision is computed in float32. Autocast changes neither.

    Args:
        query: ``(T, H, D)``; the targets are the voxels of ``pairs``, or its pixels.
        key: ``(S, H, D)``; the sources are the other side.
        value: ``(S, H, D)``.
        pairs: which target sees which source.
        direction: from the source to the target.

    Returns:
        ``(T, H, D)`` in the dtype of ``query``; zeros for a target with no pair.

    Raises:
        ShapeError: the numbers of targets or sources are not those of ``pairs``.
    """
    return _attend(query, key, value, pairs, direction)[0]


def ray_attention_in_chunks(
    query: Tensor,
    keys_and_values: Iterable[tuple[Tensor, Tensor]],
    pairs: Sequence[Pairs],
    direction: Direction = "pixels_to_voxels",
) -> Tensor:
    """Return ``ray_attention`` over sources that come in chunks, of which one at a time is read.

    One chunk is ``ray_attention`` itself. Several are joined by the online softmax of Milakov & Gimelshein
    (2018), and have no gradient: each chunk's result counts by the sum of its exponentials.

    Args:
        query: ``(T, H, D)``.
        keys_and_values: of each chunk, each ``(S, H, D)``.
        pairs: of each chunk, with the same targets.
        direction: from the source to the target.

    Returns:
        ``(T, H, D)`` in the dtype of ``query``; zeros for a target with no pair.

    Raises:
        ShapeError: the numbers of targets or sources are not those of ``pairs``.
    """
    if len(pairs) == 1:
        ((key, value),) = keys_and_values
        return ray_attention(query, key, value, pairs[0], direction)
    dtype = torch.promote_types(query.dtype, torch.float32)
    mean = torch.zeros(query.shape, dtype=dtype, device=query.device)
    log_weight = query.new_full(query.shape[:2], -torch.inf, dtype=dtype)
    with torch.no_grad():
        for (key, value), of_chunk in zip(keys_and_values, pairs, strict=True):
            chunk_mean, chunk_log_weight = ray_attention_with_sum(query, key, value, of_chunk, direction)
            joint = torch.logaddexp(log_weight, chunk_log_weight)
            # A target without a source so far: -inf minus -inf is no number, its share of nothing is zero.
            share = torch.nan_to_num((chunk_log_weight - joint).exp_())[..., None]
            mean.lerp_(chunk_mean.to(dtype), share)
            log_weight = joint
    return mean.to(query.dtype)


def ray_attention_with_sum(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    pairs: Pairs,
    direction: Direction = "pixels_to_voxels",
) -> tuple[Tensor, Tensor]:
    """Return ``ray_attention`` and the weight of each result beside those over other sources.

    Arguments and errors are those of ``ray_attention``.

    Returns:
        ``(T, H, D)``, and ``(T, H)`` ``log Σ_s exp(query[t]·key[s] / √D)``, in float32 at least; -inf for a
        target with no pair. The latter has no gradient.
    """
    out, logsumexp, to_base_2 = _attend(query, key, value, pairs, direction)
    if to_base_2:
        logsumexp = (logsumexp * log(2)).masked_fill_(logsumexp == torch.inf, -torch.inf)
    return out, logsumexp


def _attend(
    query: Tensor, key: Tensor, value: Tensor, pairs: Pairs, direction: Direction
) -> tuple[Tensor, Tensor, bool]:
    """Return the result, its log-sum-exp as the implementation gives it, and whether that is to base 2."""
    if direction not in ("pixels_to_voxels", "voxels_to_pixels"):
        raise ValueError(f"direction must be 'pixels_to_voxels' or 'voxels_to_pixels', got {direction!r}")
    to_voxels = direction == "pixels_to_voxels"
    targets, sources = (pairs.num_voxels, pairs.num_pixels)[:: 1 if to_voxels else -1]
    if query.ndim != 3 or query.shape[0] != targets:
        check_shape(query, f"{targets} H D", "query")
    for name, tensor in (("key", key), ("value", value)):
        # Words are made of sizes only to complain: torch.compile cannot make them of sizes that change.
        if tensor.shape != (sources, *query.shape[1:]):
            check_shape(tensor, f"{sources} {query.shape[1]} {query.shape[2]}", name)
    dtype = torch.promote_types(torch.promote_types(query.dtype, key.dtype), value.dtype)
    pairs = pairs_for(pairs, query.device, dtype, query.shape[2])
    if not isinstance(pairs, PairList):
        # CPU installations of torch lack Triton: its module is imported only where it runs.
        from raytran.ops.triton.attention import block_attention

        qkv = query.to(dtype), key.to(dtype), value.to(dtype)
        out, logsumexp = block_attention(*qkv, pairs, to_voxels=to_voxels)
        return out.to(query.dtype), logsumexp, True
    dtype = torch.promote_types(dtype, torch.float32)
    by_target, by_source = pairs.orders("voxels" if to_voxels else "pixels")
    place = place_with_double(query.device)
    there = [part.to(place, dtype) for part in (query, key, value)]
    out, logsumexp = pair_attention(there[0], there[1], there[2], by_target, by_source)
    return out.to(query.device, query.dtype), logsumexp.to(query.device), False
