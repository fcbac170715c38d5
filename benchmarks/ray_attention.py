# SPDX-License-Identifier: Apache-2.0
"""Ray-traced attention against dense and gather-segment attention: ``python benchmarks/ray_attention.py``.

All in one run at the paper's size: 20 views of 30×40 pixels, 48×48×16 voxels, 8 heads of 32 channels. Dense
attention is run on a slice of the targets, evenly spread, and its time scaled by their number: its work is
the same for every target. ``--dense-share 1`` runs all of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from camera_path import FEATURE_SIZE, paper_grid, recorded, walk
from timing import median_seconds, peak_mebibytes, print_machine
from torch import Tensor

from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import Direction, ray_attention
from raytran.ops.traverse import trace_pairs

HEADS, CHANNELS = 8, 32


def dense_masked(query: Tensor, key: Tensor, value: Tensor, mask: Tensor) -> Tensor:
    """Torch's fused attention with a mask of all targets × sources; a target with no pair gets no number."""
    heads_first = [tensor.transpose(0, 1)[None] for tensor in (query, key, value)]
    return torch.nn.functional.scaled_dot_product_attention(*heads_first, attn_mask=mask)[0].transpose(0, 1)


def gather_segment(query: Tensor, key: Tensor, value: Tensor, target: Tensor, source: Tensor) -> Tensor:
    """Attention as on a graph: gather both sides of each pair, softmax per target, scatter-add the values."""
    score = (query[target] * key[source]).sum(dim=-1) / query.shape[-1] ** 0.5
    spread = target[:, None].expand_as(score)
    peak = score.new_full(query.shape[:2], -torch.inf).scatter_reduce(0, spread, score, "amax")
    weight = (score - peak[target]).exp()
    total = torch.zeros_like(query[..., 0]).index_add(0, target, weight)
    weight = weight / total[target]
    return torch.zeros_like(query).index_add(0, target, weight[..., None] * value[source])


def _train(tensors: list[Tensor], pairs: PairList, direction: Direction) -> None:
    inputs = [tensor.detach().requires_grad_() for tensor in tensors]
    out = ray_attention(*inputs, pairs, direction)
    torch.autograd.grad(out, inputs, torch.ones_like(out))


def measure(pairs: PairList, direction: Direction, dense_share: float, rounds: int, backward: bool) -> None:
    """Print the medians and ratios of one direction."""
    sides = [(pairs.num_pixels, pairs.pixel_index), (pairs.num_voxels, pairs.voxel_index)]
    (sources, source), (targets, target) = sides if direction == "pixels_to_voxels" else sides[::-1]
    tensors = [torch.randn(n, HEADS, CHANNELS) for n in (targets, sources, sources)]
    forward, both = (
        partial(ray_attention, *tensors, pairs, direction),
        partial(_train, tensors, pairs, direction),
    )
    print(f"{direction}: {peak_mebibytes(forward):.0f} MiB over the inputs for the forward pass,", end=" ")
    print(f"{peak_mebibytes(both):.0f} MiB with the backward pass (results included)")
    out = forward()

    some = torch.arange(0, targets, round(1 / dense_share))
    mask = torch.zeros(len(some), sources, dtype=torch.bool)
    place = torch.full((targets,), -1).index_copy(0, some, torch.arange(len(some)))[target]
    mask[place[place >= 0], source[place >= 0]] = True
    dense = dense_masked(tensors[0][some], *tensors[1:], mask)
    met = mask.any(dim=1)
    torch.testing.assert_close(out[some][met], dense[met], atol=1e-5, rtol=0)
    torch.testing.assert_close(out, gather_segment(*tensors, target, source), atol=1e-5, rtol=0)

    candidates: dict[str, Callable[[], object]] = {
        "ray_attention": forward,
        "gather + segment softmax": lambda: gather_segment(*tensors, target, source),
        "dense masked SDPA": lambda: dense_masked(tensors[0][some], *tensors[1:], mask),
    }
    if backward:
        candidates["ray_attention, with backward"] = both
    seconds = median_seconds(candidates, rounds)
    seconds["dense masked SDPA"] *= targets / len(some)
    print(f"  dense: {len(some):,} of {targets:,} targets measured, time scaled")
    for name, taken in seconds.items():
        print(f"  {name:30s} {taken * 1e3:10.1f} ms  {taken / seconds['ray_attention']:7.1f}×")


def main() -> None:
    """Measure both directions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scan", type=Path, help="a scan in ScanNet's layout; a made-up walk without it")
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--dense-share", type=float, default=1 / 16, help="share of the targets that dense runs on"
    )
    parser.add_argument(
        "--backward", action="store_true", help="also time ray_attention with its backward pass"
    )
    arguments = parser.parse_args()
    torch.manual_seed(0)
    cameras = recorded(arguments.scan, arguments.views) if arguments.scan else walk(arguments.views)
    pairs = trace_pairs(cameras, paper_grid(cameras), FEATURE_SIZE)
    pairs.by("voxels"), pairs.by("pixels")
    print_machine()
    print(f"{pairs.num_pixels:,} pixels × {pairs.num_voxels:,} voxels, {len(pairs):,} pairs")
    for direction in ("voxels_to_pixels", "pixels_to_voxels"):
        measure(pairs, direction, arguments.dense_share, arguments.rounds, arguments.backward)


if __name__ == "__main__":
    main()
