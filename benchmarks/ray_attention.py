# SPDX-License-Identifier: Apache-2.0
"""Ray-traced attention against what one could put together: ``python benchmarks/ray_attention.py``.

All in one run, on the GPU if there is one, at the paper's size: feature maps of 30×40 pixels, 48×48×16
voxels, 8 heads of 32 channels. Dense attention is run on a slice of the targets, evenly spread, and its time
scaled by their number: its work is the same for every target. ``--dense-share 1`` runs all of them.

Memory is what is taken beyond the inputs (query, key, value, pairs with their orders, the gradient given) and
what is returned. On a GPU there are two times: as called, and on the device alone, by which candidates are
compared. The bytes bound is the time in which the device copies the bytes that must be moved at least.
A candidate that fails, or finds something else than ours, is named in its row and stops no other.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from camera_path import FEATURE_SIZE, PAPER_GRID, add_arguments, cameras_of, paper_grid
from device import Device, this_device
from flex import flex_ray_attention
from record import write_rows
from timing import MEBIBYTE, Taken, measure, print_machine, reason, tensors_in
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList, listed
from raytran.ops.ray_attention import Direction, ray_attention
from raytran.ops.traverse import RayTracer
from raytran.ops.triton.block_pairs import BlockPairs
from raytran.run.plan.roofline import measure_ceilings

HEADS, CHANNELS = 8, 32
RAYS_PER_CELL = 2
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}

JOBS = ("forward", "forward + backward")
BASELINES = {"gather": "gather + segment softmax", "dense": "dense masked SDPA", "flex": "FlexAttention"}

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


def train(attend: Attention, tensors: list[Tensor], gradient: Tensor) -> tuple[Tensor, ...]:
    """Run forward and backward; return the result and the three gradients."""
    inputs = [tensor.detach().requires_grad_() for tensor in tensors]
    out = attend(*inputs)
    return out.detach(), *torch.autograd.grad(out, inputs, gradient)


class Case:
    """One size and direction: the tensors, ours and the baselines.

    Args:
        cameras: of N views, on the device.
        grid: the volume.
        direction: from the source to the target.
        dtype: of the features.
        device: where.
        feature_size: ``(h, w)``.
        heads: H.
    """

    def __init__(
        self,
        cameras: Cameras,
        grid: VoxelGrid,
        direction: Direction,
        dtype: torch.dtype,
        device: Device,
        feature_size: tuple[int, int] = FEATURE_SIZE,
        heads: int = HEADS,
    ) -> None:
        self.cameras, self.grid, self.direction, self.device = cameras, grid, direction, device
        self.feature_size = feature_size
        self.pairs = RayTracer(device.attention)(cameras, grid, feature_size, RAYS_PER_CELL)
        self.listed: PairList = listed(self.pairs)
        indices = self.listed.pixel_index, self.listed.voxel_index
        counts = self.pairs.num_pixels, self.pairs.num_voxels
        way = slice(None) if direction == "pixels_to_voxels" else slice(None, None, -1)
        (self.source, self.target), (self.sources, self.targets) = indices[way], counts[way]
        numbers = torch.Generator().manual_seed(0)
        self.tensors = [
            torch.randn(n, heads, CHANNELS, generator=numbers).to(device.torch_device, dtype)
            for n in (self.targets, self.sources, self.sources)
        ]
        self.gradient = torch.randn(self.tensors[0].shape, generator=numbers).to(device.torch_device, dtype)

    def ours(self) -> Attention:
        """Return the operator."""
        return lambda query, key, value: ray_attention(query, key, value, self.pairs, self.direction)

    def gather(self) -> Attention:
        """Return gather, segment softmax and scatter."""
        return lambda query, key, value: gather_segment(query, key, value, self.target, self.source)

    def flex(self) -> Attention:
        """Return FlexAttention."""
        return flex_ray_attention(self.listed, self.cameras, self.grid, self.feature_size, self.direction)

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

    def baselines(self, names: list[str], share: float) -> dict[str, tuple[Attention, float] | str]:
        """Return the baselines, each with its share of the work, or why it does not run or is wrong."""
        out = self.ours()(*self.tensors).float()
        found: dict[str, tuple[Attention, float] | str] = {}
        for name in names:
            try:
                found[BASELINES[name]] = self._checked(name, out, share)
            except Exception as error:  # whatever it is, it ends this baseline alone
                found[BASELINES[name]] = reason(error)
        return found

    def _checked(self, name: str, ours: Tensor, share: float) -> tuple[Attention, float]:
        """Return a baseline and its share of the work.

        Raises:
            ValueError: it finds something else than ours.
        """
        if name == "dense":
            attend, some, met = self.dense(share)
            share = len(some) / self.targets
            actual, ours = attend(*self.tensors)[met].float(), ours[some][met]
        else:
            attend, share = self.gather() if name == "gather" else self.flex(), 1.0
            actual = attend(*self.tensors).float()
        tolerance = 1e-5 if self.tensors[0].dtype == torch.float32 else 3e-2
        equal = (actual - ours).abs().le(tolerance).flatten(1).all(dim=1).float().mean()
        # FlexAttention tests rays in float32: a pair in a million is another one.
        if equal < 0.99:
            raise ValueError(f"differs from ray_attention in {1 - equal:.1%} of the targets")
        return attend, share

    def least_bytes(self, job: str) -> int:
        """Return what must cross the memory: inputs read once, results written once, pairs read once a pass.

        Forward these are query, key, value, the result, and the masks and the order of the targets; backward
        query, key, value, the result, its gradient and the three gradients, and masks and orders of both.
        """
        query, key, value = (tensor.nbytes for tensor in self.tensors)
        sides = ("voxels", "pixels") if self.direction == "pixels_to_voxels" else ("pixels", "voxels")
        masks = self.pairs.masks.nbytes // 2 if isinstance(self.pairs, BlockPairs) else 0
        by_target, by_source = (
            masks + sum(tensor.nbytes for tensor in tensors_in(self.pairs.by(side))) for side in sides
        )
        forward = 2 * query + key + value + by_target
        backward = 4 * query + 2 * key + 2 * value + by_target + by_source
        return forward if job == "forward" else forward + backward


def measure_case(
    case: Case,
    names: list[str],
    share: float,
    rounds: int,
    bytes_per_second: float,
    jobs: Sequence[str] = JOBS,
) -> list[dict[str, Any]]:
    """Return the medians of one case, forward and with the backward pass, a row for each candidate."""
    baselines = case.baselines(names, share)
    attends = {"ray_attention": (case.ours(), 1.0)} | baselines
    rows = []
    for job in jobs:
        runs = {}
        for name, found in attends.items():
            if isinstance(found, str) or (name == BASELINES["dense"] and job != JOBS[0]):
                continue
            arguments = (case.tensors,) if job == JOBS[0] else (case.tensors, case.gradient)
            runs[name] = partial(_forward if job == JOBS[0] else train, found[0], *arguments)
        taken = measure(runs, rounds, case.device, alone=True)
        taken |= {name: Taken(error=found) for name, found in baselines.items() if isinstance(found, str)}
        ours, least = taken["ray_attention"], case.least_bytes(job) / bytes_per_second
        for name, one in taken.items():
            found = attends[name]
            rows.append(_row(case, job, name, one, 1.0 if isinstance(found, str) else found[1], ours))
            if name == "ray_attention":
                rows[-1] |= {"bound_s": least, "times_bound": _over(one.alone or one.seconds, least)}
    return rows


def _forward(attend: Attention, tensors: list[Tensor]) -> Tensor:
    return attend(*tensors)


def _row(case: Case, job: str, name: str, taken: Taken, share: float, ours: Taken) -> dict[str, Any]:
    seconds, alone = (None if time is None else time / share for time in (taken.seconds, taken.alone))
    ratio = _over(seconds, ours.seconds) if ours.alone is None else _over(alone, ours.alone)
    return {
        "direction": case.direction,
        "views": len(case.cameras.intrinsics),
        "voxels": case.grid.num_voxels,
        "pairs": len(case.listed),
        "dtype": str(case.tensors[0].dtype).removeprefix("torch."),
        "job": job,
        "what": name,
        "seconds": seconds,
        "device_seconds": alone,
        "ratio": ratio,
        "extra_mib": None if taken.extra is None or share < 1 else taken.extra / MEBIBYTE,
        "error": taken.error,
    }


def _over(a: float | None, b: float | None) -> float | None:
    return None if a is None or not b else a / b


def print_row(row: dict[str, Any]) -> None:
    """Print what a candidate took."""
    print(f"  {row['job']:18s} {row['what']:26s}", end="")
    if row["error"]:
        print(f" does not run here: {row['error']}")
        return
    alone = (
        ""
        if row["device_seconds"] is None
        else f" ({row['device_seconds'] * 1e3:.3f} ms on the device alone)"
    )
    print(f" {row['seconds'] * 1e3:10.2f} ms{alone} {row['ratio']:7.1f}×", end="")
    if row["extra_mib"] is not None:
        print(f"  {row['extra_mib']:7.0f} MiB beyond inputs and outputs", end="")
    if row.get("times_bound"):
        print(f"  {row['times_bound']:.1f}× its bytes bound", end="")
    print()


def main() -> None:
    """Measure all cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, rounds=5)
    parser.add_argument("--views", type=int, nargs="+", default=[20])
    parser.add_argument(
        "--resolution", nargs="+", default=["x".join(map(str, PAPER_GRID))], help="e.g. 48x48x16"
    )
    parser.add_argument("--dtype", nargs="+", choices=tuple(DTYPES), default=["float32"])
    parser.add_argument("--baselines", nargs="*", default=["gather", "dense"], choices=tuple(BASELINES))
    parser.add_argument(
        "--dense-share", type=float, default=1 / 16, help="share of the targets that dense runs on"
    )
    parser.add_argument("--name", default="ray_attention", help="of the CSV file")
    arguments = parser.parse_args()
    device = this_device()
    print_machine()
    bandwidth = measure_ceilings(device.torch_device).bytes_per_second
    rows = []
    for views in arguments.views:
        cameras = cameras_of(arguments, views, device.torch_device)
        for resolution in arguments.resolution:
            x, y, z = (int(n) for n in resolution.split("x"))
            for dtype in arguments.dtype:
                for direction in ("voxels_to_pixels", "pixels_to_voxels"):
                    grid = paper_grid(cameras, (x, y, z))
                    print(f"{direction}, {views} views, {resolution} voxels, {dtype}")
                    try:
                        case = Case(cameras, grid, direction, DTYPES[dtype], device)
                        found = measure_case(
                            case, arguments.baselines, arguments.dense_share, arguments.rounds, bandwidth
                        )
                    except Exception as error:  # whatever it is, it ends this size alone
                        size = {"direction": direction, "views": views, "voxels": x * y * z, "dtype": dtype}
                        found = [{**size, "job": job, "what": "all", "error": reason(error)} for job in JOBS]
                    rows += found
                    for row in found:
                        print_row(row)
    if arguments.output:
        write_rows(arguments.output / f"{arguments.name}.csv", rows)


if __name__ == "__main__":
    main()
