# SPDX-License-Identifier: Apache-2.0
"""A network as a ``.pt2`` file of ``torch.export``, with a page of JSON inside that says how to use it."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import ExportedProgram

from raytran.checkpoints.file import write_whole
from raytran.errors import ConfigError
from raytran.export.program import NetworkProgram, example_inputs, export_network, export_shapes
from raytran.model import RayTran
from raytran.run.plan.camera_paths import walk
from raytran.structs import CLASSES

_log = logging.getLogger(__name__)

SUFFIX = ".pt2"
FORMAT = "raytran.program/1"
JSON = "raytran.json"
"""The extra file in the archive: ``torch.export.load(path, extra_files={JSON: ""})`` fills it in."""

PARTS = ("network", "shapes")
_OF_CHECKPOINT = ("preset", "stage", "global_step", "scores", "git_commit", "versions")
_TRACED, _TRIED = 3, 5
"""Views of a made-up walk to trace the network with, and another number of them to try the program on."""


def export_program(
    model: RayTran,
    checkpoint: Mapping[str, Any],
    output: Path,
    *,
    image_size: tuple[int, int],
    part: str,
    tasks: Sequence[str],
    operators: str,
) -> None:
    """Write a network, or its decoder of shapes, to a file that ``torch.export.load`` opens.

    Args:
        model: the network, on the CPU.
        checkpoint: what ``read_checkpoint`` returned.
        output: the file, which appears whole or not at all, once the program in it has been run.
        image_size: ``(H, W)`` of its images.
        part: ``network`` or ``shapes``.
        tasks: heads of the network to run.
        operators: ``aten`` or ``raytran``; see ``export.program``.

    Raises:
        ConfigError: a setting is unknown, or the network has no such head.
        CheckpointError: the file cannot be written.
    """
    tasks = [tasks] if isinstance(tasks, str) else tasks  # program.tasks=objects
    about: dict[str, Any] = {"format": FORMAT, "part": part}
    module: nn.Module
    if part == "shapes":
        program, module = export_shapes(model), model.heads["shape"]
        inputs: tuple[Tensor, ...] = (torch.randn(_TRIED, model.backbone.channels),)
    elif part == "network":
        cameras = [walk(views).scaled_to(image_size) for views in (_TRACED, _TRIED)]
        program = export_network(model, cameras[0], tasks=tasks, operators=operators)
        module = NetworkProgram(model, image_size=image_size, tasks=tasks)
        inputs = example_inputs(model, cameras[1])
        about |= {"operators": operators} | _geometry(model, image_size)
    else:
        raise ConfigError(f"unknown program.part={part}: choose one of {', '.join(PARTS)}")
    about |= {name: checkpoint[name] for name in _OF_CHECKPOINT if name in checkpoint}
    file = io.BytesIO()
    torch.export.save(program, file, extra_files={JSON: json.dumps(about, indent=1)})
    _try(file, module, inputs)
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
        "classes": [*CLASSES, "padding"],
    }


@torch.no_grad()
def _try(file: io.BytesIO, module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
    """Run the program out of the file on other sizes than it was traced with; say how near it comes."""
    program: ExportedProgram = torch.export.load(file)
    expected, found = module(*inputs), program.module()(*inputs)
    if isinstance(expected, Tensor):
        expected, found = {"": expected}, {"": found}
    apart = max((expected[name] - found[name]).abs().max().item() for name in expected)
    _log.info("the program's outputs differ from the network's by at most %.1g (made-up input)", apart)
