# SPDX-License-Identifier: Apache-2.0
"""Starting runs, and comparing what two of them leave."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import torch

from raytran.checkpoints.runs import LAST
from raytran.run.entry import compose
from raytran.run.train.fit import FitResult, train


def fit(settings: Sequence[str], folder: Path, *more: str) -> FitResult:
    return train(compose("train", [*settings, f"output_dir={folder}", *more]))


def table(folder: Path) -> list[dict[str, str]]:
    """Return the logged rows without times and sizes, which are not the same twice."""
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    kept = [
        {name: value for name, value in row.items() if value and name.startswith(("train/", "val/", "step"))}
        for row in rows
    ]
    return [row for row in kept if len(row) > 1]


def assert_same(folder: Path, straight: Path) -> None:
    """Check that two runs end with the same weights to the last bit and have logged the same."""
    ours, theirs = (torch.load(path / LAST, weights_only=True) for path in (folder, straight))
    assert ours["global_step"] == theirs["global_step"]
    for name, value in theirs["state_dict"].items():
        assert torch.equal(ours["state_dict"][name], value), name
    for ours_state, theirs_state in zip(
        ours["optimizer_states"][0]["state"].values(),
        theirs["optimizer_states"][0]["state"].values(),
        strict=True,
    ):
        assert all(torch.equal(ours_state[name], value) for name, value in theirs_state.items())
    assert ours["lr_schedulers"][0]["last_epoch"] == theirs["lr_schedulers"][0]["last_epoch"]
    assert torch.equal(ours["resume"]["random"][0]["torch"], theirs["resume"]["random"][0]["torch"])
    assert ours["SceneDataModule"] == theirs["SceneDataModule"]
    assert table(folder) == table(straight)
