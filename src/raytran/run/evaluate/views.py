# SPDX-License-Identifier: Apache-2.0
"""How well a model renders views that it was not given: numbers in all, and by view."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rich.progress import track
from rich.table import Table
from torch.utils.data import Dataset

from raytran.data.views import RepeatedFrames
from raytran.metrics import NewViewScores
from raytran.model import RayTran, inputs_of
from raytran.run.evaluate.score import write_csv
from raytran.run.output import replaced_folder
from raytran.structs import SceneBatch

FILES = ("metrics.json", "per_view.csv")
"""What is written; the first file tells a finished result."""


@torch.no_grad()
def evaluate_views(
    model: RayTran,
    dataset: Dataset[SceneBatch],
    *,
    output: Path | None = None,
    views_at_once: int | None = None,
    about: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Render the new views of every scene of a data set and compare with the photographs.

    Args:
        model: a network with a view head, on any device; put in evaluation mode.
        dataset: scenes with ``new_views``, each a ``SceneBatch`` with B = 1.
        output: folder for ``metrics.json`` and ``per_view.csv``, which appear together or not at all; None
            writes nothing.
        views_at_once: views that pass through the network together, None for all.
        about: what to say beside the numbers, e.g. the checkpoint.
        progress: show a progress bar.

    Returns:
        ``new_views`` with what ``NewViewScores`` returns, and what ``about`` says.
    """
    device = next(model.parameters()).device
    scores = NewViewScores().to(device)
    model.eval()
    repeated = RepeatedFrames()
    for index in track(range(len(dataset)), "evaluating", disable=not progress, transient=True):  # type: ignore[arg-type]
        batch = dataset[index].to(device)
        repeated.look(batch)
        raw = model(**inputs_of(batch), tasks=("view",), views_at_once=views_at_once)
        (prediction,) = model.decode(raw, batch.scene_id)
        if prediction.new_views is not None and batch.new_views is not None:
            scores.update(prediction.new_views[None], batch.new_views, batch.views, batch.scene_id)
    metrics = {**(about or {}), "new_views": scores.compute()}
    if output is not None:
        with replaced_folder(output, marker=FILES[0]) as folder:
            (folder / FILES[0]).write_text(json.dumps(metrics, indent=2) + "\n")
            write_csv(folder / FILES[1], scores.rows())
    return metrics


def views_table(metrics: Mapping[str, Any], *, title: str) -> Table:
    """Return the numbers as a table for the terminal."""
    found = metrics["new_views"]
    table = Table(f"{found['n_views']} new views", "PSNR, dB", "SSIM", title=title)
    table.add_row("rendered", f"{found['psnr']:.2f}", f"{found['ssim']:.3f}")
    table.add_section()
    table.add_row("each view's own mean colour", f"{found['psnr_best_constant']:.2f}", "")
    table.add_row("the frame of the nearest camera", f"{found['psnr_nearest_frame']:.2f}", "")
    return table
