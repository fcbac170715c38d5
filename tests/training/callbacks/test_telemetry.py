# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.loggers import Logger

from raytran.training.callbacks.telemetry import Telemetry


class Rows(Logger):
    """Keeps what is logged."""

    def __init__(self):
        super().__init__()
        self.rows, self.settings = [], None

    name, version = "rows", 0

    def log_metrics(self, metrics, step=None):
        self.rows.append({"step": step, **metrics})

    def log_hyperparams(self, settings):
        self.settings = settings


class Sleep(pl.Callback):
    """Takes its time in a step."""

    def on_before_zero_grad(self, *_):
        time.sleep(0.2)


def test_times_are_means_over_the_steps_since_the_last_logging(fit):
    rows = Rows()
    fit(Telemetry({"seed": 3}), Sleep(), experiment="stage1", loggers=rows, max_steps=4, log_every_n_steps=2)
    assert rows.settings == {"seed": 3}
    assert [row["step"] for row in rows.rows] == [1, 3]
    for row in rows.rows:
        assert 0.2 <= row["time/compute"] < 2
        assert 0 <= row["time/data"] < row["time/compute"]
        both = row["time/data"] + row["time/compute"]
        assert row["time/scenes_per_second"] == pytest.approx(1 / both, rel=1e-4)
        assert 0.1 < row["memory/process"] < 50
        assert "memory/gpu" not in row
    assert 0 < rows.rows[0]["schedule/learning_rate"] < rows.rows[1]["schedule/learning_rate"] < 1e-3


def test_a_step_of_several_batches_is_one_step(fit):
    rows = Rows()
    fit(
        *(Telemetry({}), Sleep()),
        experiment="stage1",
        loggers=rows,
        max_steps=2,
        log_every_n_steps=2,
        accumulate_grad_batches=2,
    )
    (row,) = rows.rows
    both = row["time/data"] + row["time/compute"]
    assert row["time/scenes_per_second"] == pytest.approx(2 / both, rel=1e-4)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_memory_of_the_gpu(fit):
    rows = Rows()
    fit(Telemetry({}), experiment="stage1", loggers=rows, max_steps=2, accelerator="gpu", devices=1)
    assert 0 < rows.rows[-1]["memory/gpu"] < 10
