# SPDX-License-Identifier: Apache-2.0
"""Operations and least bytes of each part of a training step: the parts of ``step_parts`` on fake tensors."""

from __future__ import annotations

from step_parts import Part, step_parts
from torch import Tensor

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.model import RayTran
from raytran.ops.pairs import PairList
from raytran.run.plan.dry_run import Load, Tally, autocast, backward, dry_network
from raytran.run.plan.roofline import Work
from raytran.training.stage import Stage


def work_of_parts(
    model: RayTran, load: Load, *, precision: str = "32-true", stage: Stage | None = None
) -> dict[str, Work]:
    """Return the work of each part of a training step, forward and backward, losses and optimiser apart.

    Args:
        model: the network.
        load: the size of the step.
        precision: of the features.
        stage: whose heads run; None for all.
    """
    with dry_network(model, load, precision) as (network, tally):
        network.train().requires_grad_(True)
        views = load.fake_views(network.backbone.encoder.input_channels)
        cameras = Cameras.of(views)
        grid = VoxelGrid(network.grid_resolution, network.grid_extent, cameras.position.mean(dim=1))
        pairs = network.trace(cameras, grid)
        parts = step_parts(network, views, pairs, **({} if stage is None else {"tasks": stage.tasks}))
        with autocast(precision):
            return {part.name: _work(part, network, load, pairs, tally) * part.times for part in parts}


def _work(part: Part, model: RayTran, load: Load, pairs: PairList, tally: Tally) -> Work:
    """Return the work of one run of a part; what makes the pairs is counted by formula."""
    if part.over_pairs in ("traversal", "projection"):
        # Each ray is cut by the planes of three axes; a pair is written as two integers.
        planes = sum(model.grid_resolution) * model.rays_per_cell**2 * pairs.num_pixels
        written = 16.0 * load.pairs_per_pixel * pairs.num_pixels
        return Work(10.0 * planes if part.over_pairs == "traversal" else 0.0, written)
    before = len(tally.work)
    out = part.run()
    if isinstance(out, Tensor):
        backward(out)
    return sum(tally.work[before:], Work(0.0, 0.0))
