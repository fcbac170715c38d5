# SPDX-License-Identifier: Apache-2.0
"""How far one has to read: the files that a training step and a prediction pass through, and how often.

    python benchmarks/reading.py

A profiler hook follows every call into ``src/raytran`` during one training step (forward, loss, backward) and
one prediction of a small network on the CPU, and counts the files entered, the calls from one file into
another, and their depth. It says nothing of time: it is a measure of the code.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import torch

import raytran
from raytran.run.entry import compose
from raytran.run.train.build import build_model, build_module
from raytran.structs import ObjectSet, SceneBatch, Views

PACKAGE = Path(raytran.__file__).resolve().parent
SMALL = [
    "preset=tiny",
    "model/extensions=[]",
    "model.grid_resolution=[6,6,4]",
    "model.backbone.channels=16",
    "model.backbone.encoder.width=8",
    "model.heads.objects.num_heads=2",
    "model.heads.objects.num_layers=2",
    "model.heads.foreground.widths=[8,8,4]",
    "views.image_size=[32,48]",
    "output_dir=unused",
]
"""The paper's network at the size of the tests."""


@dataclass
class Walk:
    """The way of a call through the package.

    Attributes:
        files: entered, in the order of the first visit.
        functions: entered.
        changes: calls that led from one file into another.
        depth: the most calls of the package that were open at once.
    """

    files: dict[str, None] = field(default_factory=dict)
    functions: set[tuple[str, str]] = field(default_factory=set)
    changes: int = 0
    depth: int = 0


def walk(run: Callable[[], Any]) -> Walk:
    """Return the way of ``run()`` through the package."""
    found = Walk()
    open_files: list[str] = []

    def follow(frame: FrameType, event: str, argument: Any) -> None:
        path = frame.f_code.co_filename
        if event not in ("call", "return") or not path.startswith(str(PACKAGE)):
            return
        if frame.f_code.co_name.startswith("<"):  # comprehensions and lambdas are read where they stand
            return
        file = str(Path(path).relative_to(PACKAGE))
        if event == "return":
            if open_files:
                open_files.pop()
            return
        found.changes += bool(open_files) and open_files[-1] != file
        open_files.append(file)
        found.files.setdefault(file)
        found.functions.add((file, frame.f_code.co_qualname))
        found.depth = max(found.depth, len(open_files))

    sys.setprofile(follow)
    try:
        run()
    finally:
        sys.setprofile(None)
    return found


def small_batch() -> SceneBatch:
    """Return one scene of two views and three objects, with the targets of stage 2."""
    g = torch.Generator().manual_seed(1)
    pose = torch.eye(4).repeat(1, 2, 1, 1)
    pose[..., :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[..., :3, 3] = torch.rand(1, 2, 3, generator=g)
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(1, 2, 3, 3)
    images = torch.randint(0, 256, (1, 2, 3, 32, 48), generator=g).to(torch.uint8)
    objects = ObjectSet(
        label=torch.arange(3),
        center=torch.rand(3, 3, generator=g),
        size=torch.rand(3, 3, generator=g) + 0.2,
        rotation=torch.eye(3).expand(3, 3, 3),
        symmetry=torch.ones(3, dtype=torch.long),
        score=torch.ones(3),
    )
    return SceneBatch(
        ("scene",),
        Views(images, intrinsics, pose),
        ((),),
        pose[:, :, :3, 3].mean(dim=1),
        occupancy=torch.rand(1, 6, 6, 4, generator=g) > 0.9,
        foreground=torch.rand(1, 2, 32, 48, generator=g) > 0.5,
        objects=(objects,),
    )


def training_step() -> Walk:
    """Return the way of one training step of stage 2, with its backward pass."""
    cfg = compose("train", [*SMALL, "experiment=stage2"])
    module = build_module(cfg, build_model(cfg, pretrained=False))
    module.stage.freeze(module.model)
    module.stage.set_modes(module.model)
    module.log = lambda *_, **__: None
    batch = small_batch()

    def step() -> None:
        outcome = module.training_step(batch, 0)
        (outcome["loss"] if isinstance(outcome, dict) else outcome).backward()

    step()  # what is made once, imports among it, is no part of a step
    return walk(step)


def prediction() -> Walk:
    """Return the way of ``RayTran.predict``."""
    cfg = compose("train", SMALL)
    model = build_model(cfg, pretrained=False)
    views = small_batch().views
    model.predict(views)
    return walk(lambda: model.predict(views))


def main() -> None:
    """Print what was found."""
    for name, found in (("training step", training_step()), ("predict", prediction())):
        print(
            f"{name}: {len(found.files)} files, {len(found.functions)} functions, "
            f"{found.changes} calls into another file, depth {found.depth}"
        )
        print("  " + " ".join(found.files))


if __name__ == "__main__":
    main()
