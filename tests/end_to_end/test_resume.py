# SPDX-License-Identifier: Apache-2.0
"""A run that was stopped and resumed ends as one that was not: same weights, same logged metrics."""

from __future__ import annotations

import csv
import random

import numpy as np
import pytest
import torch

from raytran.run.entry import compose
from raytran.run.folders import LAST
from raytran.run.train import train
from raytran.training.reconstruction import Reconstruction

STEPS = 8


class Killed(BaseException):
    """Stands for SIGKILL: nothing of the run's own hears of it."""


@pytest.fixture(scope="module")
def base(settings):
    """Validation after steps 3 and 6; checkpoints after 2, 4, 6."""
    return [*settings, f"trainer.max_steps={STEPS}", "trainer.val_check_interval=3", "checkpoint_every=2"]


def fit(base, folder, *more):
    return train(compose("train", [*base, f"output_dir={folder}", "resume=auto", *more]))


def table(folder):
    """Return the logged rows; times and sizes are not the same twice."""
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    return [
        {name: value for name, value in row.items() if value and name.startswith(("train/", "val/", "step"))}
        for row in rows
    ]


def assert_same(folder, straight):
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


def kill_at(monkeypatch, hook, call):
    """Let the ``call``-th call of a method of the module raise, before it does anything."""
    original, calls = getattr(Reconstruction, hook), []

    def counted(*arguments, **named):
        calls.append(None)
        if len(calls) == call:
            raise Killed
        return original(*arguments, **named)

    monkeypatch.setattr(Reconstruction, hook, counted)


@pytest.fixture(scope="module", autouse=True)
def chance():
    """Random numbers in every step: the network draws none of its own yet, and may one day."""
    original = Reconstruction.training_step

    def step(self, batch, batch_idx):
        return original(self, batch, batch_idx) * (torch.rand(()) + random.random() + np.random.rand())  # noqa: NPY002

    with pytest.MonkeyPatch.context() as context:
        context.setattr(Reconstruction, "training_step", step)
        yield


@pytest.fixture(scope="module")
def straight(base, tmp_path_factory):
    """A run that nobody stopped."""
    folder = fit(base, tmp_path_factory.mktemp("straight") / "run").folder
    assert [row["step"] for row in table(folder) if "val/total" in row] == ["2", "5"]
    assert [row["step"] for row in table(folder) if "train/total" in row] == [str(i) for i in range(STEPS)]
    return folder


@pytest.mark.parametrize(
    ("hook", "call"),
    [
        ("training_step", 4),  # from the checkpoint of step 2, in the middle of an epoch
        ("validation_step", 1),  # in the validation after step 3
        ("on_validation_epoch_end", 2),  # at the end of the one after step 6: the checkpoint is of step 4
        ("training_step", 7),  # checkpoint of step 6, written after its validation
    ],
)
def test_a_kill_anywhere(base, straight, tmp_path, monkeypatch, hook, call):
    with monkeypatch.context() as context:
        kill_at(context, hook, call)
        with pytest.raises(Killed):
            fit(base, tmp_path / "run")
    fit(base, tmp_path / "run")
    assert_same(tmp_path / "run", straight)
