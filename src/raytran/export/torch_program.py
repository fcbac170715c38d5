# SPDX-License-Identifier: Apache-2.0
"""The network as a program of ``torch.export``: a graph of operators with its weights, no Python of ours.

It takes the pixel-voxel pairs as an input, as ``trace_pairs`` gives them. Ray-traced attention is written in
torch's own operators, so that the program runs where raytran is not installed; or it stays an operator of
raytran, which is several times faster and must be imported first. A ``.pt2`` file has a page of JSON inside
that says how to use it.
"""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from raytran.checkpoints.file import write_whole
from raytran.classes import PADDING_NAME
from raytran.errors import ConfigError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.model import TASKS, RayTran
from raytran.ops.pairs import PairList

_log = logging.getLogger(__name__)

SUFFIX = ".pt2"
FORMAT = "raytran.program/1"
JSON = "raytran.json"
"""The extra file in the archive: ``torch.export.load(path, extra_files={JSON: ""})`` fills it in."""

PARTS = ("network", "shapes")
OPERATORS = ("aten", "raytran")

_OF_CHECKPOINT = ("preset", "stage", "global_step", "scores", "git_commit", "versions")
"""What the JSON repeats of a checkpoint."""

_TRACED = 3
"""Views that a program is traced with; it takes any number from two on."""

_RAYTRAN = torch.ops.raytran


class NetworkProgram(nn.Module):
    """What becomes a program: one scene in plain tensors, ``RayTran.forward`` without its tracing of rays.

    Args:
        model: the network.
        image_size: ``(H, W)`` of its images.
        tasks: some of ``TASKS``.
    """

    def __init__(self, model: RayTran, *, image_size: tuple[int, int], tasks: Collection[str]) -> None:
        super().__init__()
        self.model = model
        self.image_size = image_size
        self.tasks = tuple(tasks)

    def forward(
        self,
        images: Tensor,
        intrinsics: Tensor,
        world_from_camera: Tensor,
        grid_center: Tensor,
        pixel_index: Tensor,
        voxel_index: Tensor,
    ) -> dict[str, Tensor]:
        """Run the network on one scene.

        Args:
            images: ``(N, 3 or 4, H, W)`` uint8.
            intrinsics: ``(N, 3, 3)`` for images of that size.
            world_from_camera: ``(N, 4, 4)``.
            grid_center: ``(3,)`` centre of the voxel grid, metres.
            pixel_index: ``(P,)`` int64, as in ``PairList``.
            voxel_index: ``(P,)`` int64.

        Returns:
            Raw predictions without a batch dimension. ``occupancy`` ``(X, Y, Z)`` logits; ``foreground``
            ``(N, H, W)`` logits; and of the last decoder layer ``class_logits`` ``(Q, K + 1)``, ``center``
            ``(Q, 3)``, ``log_size`` ``(Q, 3)``, ``yaw_vector`` ``(Q, 2)`` and ``embedding`` ``(Q, C)``, as in
            ``RawObjects``.
        """
        backbone, heads = self.model.backbone, self.model.heads
        cameras = Cameras(intrinsics[None], world_from_camera[None], self.image_size)
        grid = VoxelGrid(self.model.grid_resolution, self.model.grid_extent, grid_center[None])
        cells = (self.image_size[0] // backbone.stride) * (self.image_size[1] // backbone.stride)
        pairs = PairList(pixel_index, voxel_index, images.shape[0] * cells, grid.num_voxels)
        with_pixels = "foreground" in self.tasks
        voxels, pixels = backbone([images[None]], [cameras], grid, [pairs], with_pixels=with_pixels)
        outputs = {}
        if "occupancy" in self.tasks:
            outputs["occupancy"] = heads["occupancy"](voxels)[0]
        if pixels is not None:
            outputs["foreground"] = heads["foreground"](pixels[0])[0]
        if "objects" in self.tasks:
            last = self.model.find_objects(voxels, grid).layers[-1]
            of_queries = ("class_logits", "center", "log_size", "yaw_vector", "embedding")
            outputs |= {name: getattr(last, name)[0] for name in of_queries}
        return outputs


def example_inputs(model: RayTran, cameras: Cameras, *, seed: int = 0) -> tuple[Tensor, ...]:
    """Return inputs of ``NetworkProgram``: noise for images, and the pairs of some cameras.

    Args:
        model: the network, on the CPU.
        cameras: of leading shape ``(N,)``, for images of the network's size.
        seed: of the noise.
    """
    height, width = cameras.image_size
    generator = torch.Generator().manual_seed(seed)
    size = (cameras.position.shape[0], model.backbone.encoder.input_channels, height, width)
    images = torch.randint(0, 256, size, dtype=torch.uint8, generator=generator)
    cameras = cameras.to(torch.float32)
    center = cameras.position.mean(dim=0)
    grid = VoxelGrid(model.grid_resolution, model.grid_extent, center[None])
    pairs = cast("PairList", model.trace(cameras[None], grid))  # on the CPU it is a list
    poses = cameras.world_from_camera
    return images, cameras.intrinsics, poses, center, pairs.pixel_index, pairs.voxel_index


@torch.no_grad()
def export_network(
    model: RayTran, cameras: Cameras, *, tasks: Collection[str], operators: str = "aten"
) -> ExportedProgram:
    """Return the network as a program for any number of views, from two on, and of pairs.

    Args:
        model: the network, on the CPU, in evaluation mode.
        cameras: three or more to trace the program with; they leave nothing behind but their image size.
        tasks: which heads to run, some of ``TASKS``.
        operators: ``aten``, torch's own; or ``raytran``, those of ``ops.pair_attention`` and ``ops.splat``.

    Raises:
        ConfigError: there is no such task or no such head, or ``operators`` is unknown.
    """
    missing = [name for name in tasks if name not in TASKS or name not in model.heads]
    if missing or not tasks:
        choices = [name for name in TASKS if name in model.heads]
        raise ConfigError(f"unknown tasks={list(tasks)}: choose some of {', '.join(choices)}")
    if operators not in OPERATORS:
        raise ConfigError(f"unknown operators={operators}: choose one of {', '.join(OPERATORS)}")
    views, pairs = Dim("views", min=2, max=1 << 16), Dim("pairs", min=2)
    program = torch.export.export(
        NetworkProgram(model, image_size=cameras.image_size, tasks=tasks),
        example_inputs(model, cameras),
        dynamic_shapes=({0: views}, {0: views}, {0: views}, None, {0: pairs}, {0: pairs}),
    )
    return program.run_decompositions(_in_aten() if operators == "aten" else {})


@torch.no_grad()
def export_shapes(model: RayTran) -> ExportedProgram:
    """Return the shape head as a program: ``embedding`` ``(M, C)`` → logits ``(M, S, S, S)``, M from 1 on.

    Raises:
        ConfigError: the network has no shape head.
    """
    if "shape" not in model.heads:
        raise ConfigError("this network has no shape head: export program.part=network")
    # A shape head of the user's own need not tell.
    read = int(getattr(model.heads["shape"], "in_channels", model.backbone.channels))
    embedding = torch.zeros(3, read)
    objects = Dim("objects", min=1)
    program = torch.export.export(model.heads["shape"], (embedding,), dynamic_shapes=({0: objects},))
    return program.run_decompositions({})


def _in_aten() -> dict[object, object]:
    """Return how to write raytran's operators in torch's own."""
    return {
        _RAYTRAN.pair_attention.default: _attention_in_aten,
        _RAYTRAN.pair_mean.default: _mean_in_aten,
    }


def _attention_in_aten(
    query: Tensor, key: Tensor, value: Tensor, by_target: Sequence[Tensor], by_source: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Do what ``pair_attention._attend`` does, but for what only the backward pass reads.

    Heads come one by one: all together would need memory for P · H · D numbers.
    """
    offsets, source, _ = by_target
    target = _rows(offsets, source)
    scaled = query * query.shape[2] ** -0.5
    outputs, logsumexp = [], []
    for head in range(query.shape[1]):
        of_source = key[:, head].index_select(0, source)
        score = (scaled[:, head].index_select(0, target) * of_source).sum(dim=1)
        greatest = torch.segment_reduce(score, "max", offsets=offsets, unsafe=True)
        exponential = (score - greatest.index_select(0, target)).exp()
        total = torch.segment_reduce(exponential, "sum", offsets=offsets, initial=0, unsafe=True)
        weighted = exponential[:, None] * value[:, head].index_select(0, source)
        summed = torch.segment_reduce(weighted, "sum", offsets=offsets, initial=0, unsafe=True)
        outputs.append(summed / total.where(total > 0, 1.0)[:, None])
        logsumexp.append(greatest + total.log())
    sums = torch.stack(logsumexp, dim=1)
    return torch.stack(outputs, dim=1), sums, query.new_empty(query.shape[1], source.shape[0]), sums


def _mean_in_aten(features: Tensor, by_voxel: Sequence[Tensor], by_pixel: Sequence[Tensor]) -> Tensor:
    """Do what ``splat._mean`` does."""
    offsets, pixel, _ = by_voxel
    read = features.index_select(0, pixel)
    return torch.segment_reduce(read, "mean", offsets=offsets, initial=0, unsafe=True)


def _rows(offsets: Tensor, like: Tensor) -> Tensor:
    """Return the row of each pair, ``(P,)``."""
    rows = torch.arange(offsets.shape[0] - 1, device=offsets.device)
    return torch.repeat_interleave(rows, offsets.diff(), output_size=like.shape[0])


def export_program(
    model: RayTran,
    checkpoint: Mapping[str, Any],
    output: Path,
    *,
    cameras: Cameras,
    part: str,
    tasks: Sequence[str],
    operators: str,
) -> None:
    """Write a network, or its decoder of shapes, to a file that ``torch.export.load`` opens.

    Args:
        model: the network, on the CPU.
        checkpoint: what ``read_checkpoint`` returned.
        output: the file, which appears whole or not at all, once the program in it has been run.
        cameras: at least five for images of the network's size; the program is traced with the first few and
            tried on all of them, and nothing else of them is left in it.
        part: ``network`` or ``shapes``.
        tasks: heads of the network to run.
        operators: ``aten`` or ``raytran``; see ``export_network``.

    Raises:
        ConfigError: a setting is unknown, or the network has no such head.
        CheckpointError: the file cannot be written.
    """
    tasks = [tasks] if isinstance(tasks, str) else tasks  # program.tasks=objects
    about: dict[str, Any] = {"format": FORMAT, "part": part}
    num_tried = len(cameras.position)
    module: nn.Module
    if part == "shapes":
        program, module = export_shapes(model), model.heads["shape"]
        inputs: tuple[Tensor, ...] = (torch.randn(num_tried, model.backbone.channels),)
    elif part == "network":
        program = export_network(model, cameras[:_TRACED], tasks=tasks, operators=operators)
        module = NetworkProgram(model, image_size=cameras.image_size, tasks=tasks)
        inputs = example_inputs(model, cameras)
        about |= {"operators": operators} | _geometry(model, cameras.image_size)
    else:
        raise ConfigError(f"unknown program.part={part}: choose one of {', '.join(PARTS)}")
    about |= {name: checkpoint[name] for name in _OF_CHECKPOINT if name in checkpoint}
    file = io.BytesIO()
    torch.export.save(program, file, extra_files={JSON: json.dumps(about, indent=1)})
    _try_program(file, module, inputs)
    write_whole(output, file.getvalue())


def _geometry(model: RayTran, image_size: tuple[int, int]) -> dict[str, Any]:
    """Return what one must know to make the network's inputs and to read its outputs."""
    stride = model.backbone.stride
    return {
        "image_size": list(image_size),
        "feature_size": [side // stride for side in image_size],
        "rays_per_cell": model.rays_per_cell,
        "grid_resolution": list(model.grid_resolution),
        "grid_extent": list(model.grid_extent),
        "classes": [*model.classes.names, PADDING_NAME],
        "score_scaling": None if model.score_scaling is None else model.score_scaling.settings(),
    }


@torch.no_grad()
def _try_program(file: io.BytesIO, module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
    """Run the program out of the file on other sizes than it was traced with; say how near it comes."""
    program: ExportedProgram = torch.export.load(file)
    expected, computed = module(*inputs), program.module()(*inputs)
    if isinstance(expected, Tensor):
        expected, computed = {"": expected}, {"": computed}
    apart = max((expected[name] - computed[name]).abs().max().item() for name in expected)
    _log.info("the program's outputs differ from the network's by at most %.1g (made-up input)", apart)
