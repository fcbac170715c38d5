# SPDX-License-Identifier: Apache-2.0
"""Ray-traced attention against what one could put together: ``python benchmarks/ray_attention.py``.

All in one run, on the GPU if there is one, at the paper's size: feature maps of 30×40 pixels, 48×48×16
voxels, 8 heads of 32 channels. Dense attention is run on a slice of the targets, evenly spread, and its time
scaled by their number: its work is the same for every target. ``--dense-share 1`` runs all of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from camera_path import FEATURE_SIZE, PAPER_GRID, add_arguments, cameras_of, paper_grid
from flex import flex_ray_attention
from record import write_rows
from timing import median_seconds, peak_mebibytes, print_machine
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.fused import listed
from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import Direction, ray_attention
from raytran.ops.ray_tracer import RayTracer

HEADS, CHANNELS = 8, 32
RAYS_PER_CELL = 2
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}

Attention = Callable[[Tensor, Tensor, Tensor], Tensor]


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


def train(attend: Attention, tensors: list[Tensor]) -> None:
    """Run forward and backward."""
    inputs = [tensor.detach().requires_grad_() for tensor in tensors]
    out = attend(*inputs)
    torch.autograd.grad(out, inputs, torch.ones_like(out))


class Case:
    """One size and direction: the tensors, ours and the baselines.

    Args:
        cameras: of N views.
        grid: the volume.
        direction: from the source to the target.
        dtype: of the features.
        device: where.
    """

    def __init__(
        self,
        cameras: Cameras,
        grid: VoxelGrid,
        direction: Direction,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self.cameras, self.grid, self.direction = cameras, grid, direction
        self.pairs = RayTracer()(cameras, grid, FEATURE_SIZE, RAYS_PER_CELL)
        self.listed: PairList = listed(self.pairs)
        indices = self.listed.pixel_index, self.listed.voxel_index
        counts = self.pairs.num_pixels, self.pairs.num_voxels
        way = slice(None) if direction == "pixels_to_voxels" else slice(None, None, -1)
        (self.source, self.target), (self.sources, self.targets) = indices[way], counts[way]
        numbers = torch.Generator(device).manual_seed(0)
        self.tensors = [
            torch.randn(n, HEADS, CHANNELS, generator=numbers, device=device).to(dtype)
            for n in (self.targets, self.sources, self.sources)
        ]

    def ours(self) -> Attention:
        """Return the operator."""
        return lambda query, key, value: ray_attention(query, key, value, self.pairs, self.direction)

    def gather(self) -> Attention:
        """Return gather, segment softmax and scatter."""
        return lambda query, key, value: gather_segment(query, key, value, self.target, self.source)

    def flex(self) -> Attention:
        """Return FlexAttention."""
        return flex_ray_attention(self.listed, self.cameras, self.grid, FEATURE_SIZE, self.direction)

    def dense(self, share: float) -> tuple[Attention, Tensor, Tensor]:
        """Return dense attention on some targets, which these are, and which of them have a pair."""
        device = self.target.device
        some = torch.arange(0, self.targets, round(1 / share), device=device)
        mask = torch.zeros(len(some), self.sources, dtype=torch.bool, device=device)
        number = torch.full((self.targets,), -1, device=device)
        place = number.index_copy(0, some, torch.arange(len(some), device=device))[self.target]
        mask[place[place >= 0], self.source[place >= 0]] = True
        return (
            (lambda query, key, value: dense_masked(query[some], key, value, mask)),
            some,
            mask.any(dim=1),
        )

    def baselines(self, names: list[str], share: float) -> dict[str, tuple[Attention, float]]:
        """Return the baselines that run, each checked against ours, with its share of the work."""
        makers = {
            "gather": ("gather + segment softmax", self.gather),
            "flex": ("FlexAttention", self.flex),
        }
        out = self.ours()(*self.tensors).float()
        tolerance = {"atol": 1e-5 if self.tensors[0].dtype == torch.float32 else 3e-2, "rtol": 0}
        found: dict[str, tuple[Attention, float]] = {}
        for name, make in (makers[name] for name in names if name in makers):
            try:
                attend = make()
                close = torch.isclose(attend(*self.tensors).float(), out, **tolerance)
            except RuntimeError as error:
                print(f"  {name}: does not run here ({str(error).splitlines()[0]})")
                continue
            # FlexAttention tests rays in float32: a pair in a million is another one.
            assert close.flatten(1).all(dim=1).float().mean() > 0.99
            found[name] = attend, 1.0
        if "dense" in names:
            attend, some, met = self.dense(share)
            torch.testing.assert_close(attend(*self.tensors)[met].float(), out[some][met], **tolerance)
            found["dense masked SDPA"] = attend, len(some) / self.targets
        return found


def measure(case: Case, names: list[str], share: float, rounds: int) -> list[dict[str, Any]]:
    """Return and print the medians of one case, forward and with the backward pass."""
    candidates = {"ray_attention": (case.ours(), 1.0), **case.baselines(names, share)}
    rows = []
    for job in ("forward", "forward + backward"):
        runs, peaks = {}, {}
        for name, (attend, _) in candidates.items():
            if name == "dense masked SDPA" and job != "forward":
                continue
            run = partial(attend, *case.tensors) if job == "forward" else partial(train, attend, case.tensors)
            try:
                peaks[name] = peak_mebibytes(run)
            except (RuntimeError, NotImplementedError) as error:
                print(f"  {name}, {job}: does not run here ({str(error).splitlines()[0]})")
                continue
            runs[name] = run
        seconds = median_seconds(runs, rounds)
        for name, taken in seconds.items():
            full = taken / candidates[name][1]
            ratio = full / seconds["ray_attention"]
            rows.append(
                {
                    "direction": case.direction,
                    "views": len(case.cameras.intrinsics),
                    "voxels": case.grid.num_voxels,
                    "pairs": len(case.listed),
                    "dtype": str(case.tensors[0].dtype).removeprefix("torch."),
                    "job": job,
                    "what": name,
                    "seconds": full,
                    "ratio": ratio,
                    "peak_mib": peaks[name] if candidates[name][1] == 1 else "",
                }
            )
            print(
                f"  {job:18s} {name:26s} {full * 1e3:10.2f} ms {ratio:7.1f}×"
                f"  {peaks[name]:7.0f} MiB over inputs"
            )
    return rows


def main() -> None:
    """Measure all cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, rounds=5)
    parser.add_argument("--views", type=int, nargs="+", default=[20])
    parser.add_argument(
        "--resolution", nargs="+", default=["x".join(map(str, PAPER_GRID))], help="e.g. 48x48x16"
    )
    parser.add_argument("--dtype", nargs="+", choices=tuple(DTYPES), default=["float32"])
    parser.add_argument("--baselines", nargs="*", default=["gather", "dense"], help="gather, dense, flex")
    parser.add_argument(
        "--dense-share", type=float, default=1 / 16, help="share of the targets that dense runs on"
    )
    parser.add_argument("--name", default="ray_attention", help="of the CSV file")
    arguments = parser.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    print_machine()
    rows = []
    for views in arguments.views:
        cameras = cameras_of(arguments, views, device)
        for resolution in arguments.resolution:
            x, y, z = (int(n) for n in resolution.split("x"))
            for dtype in arguments.dtype:
                for direction in ("voxels_to_pixels", "pixels_to_voxels"):
                    case = Case(cameras, paper_grid(cameras, (x, y, z)), direction, DTYPES[dtype], device)
                    size = f"{views} views, {resolution} voxels, {dtype}"
                    print(f"{direction}, {size}: {len(case.listed):,} pairs")
                    rows += measure(case, arguments.baselines, arguments.dense_share, arguments.rounds)
    if arguments.output:
        write_rows(arguments.output / f"{arguments.name}.csv", rows)


if __name__ == "__main__":
    main()
