# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import LearningRateMonitor
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from raytran.training.callbacks import telemetry
from raytran.training.callbacks.telemetry import HP_METRIC, RunSettings, Telemetry


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


class Clock(pl.Callback):
    """A clock by which the n-th batch takes n seconds, and half a second lies between two of them."""

    def __init__(self):
        self.now, self.batches = 100.0, 0

    def on_before_backward(self, *_):
        self.batches += 1
        self.now += self.batches

    def on_train_batch_end(self, *_):
        self.now += 0.5


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(telemetry.time, "perf_counter", lambda: clock.now)
    return clock


def test_times_are_means_over_the_steps_since_the_last_logging(fit, clock):
    rows = Rows()
    fit(Telemetry(), clock, experiment="stage1", loggers=rows, max_steps=4, log_every_n_steps=2)
    assert [row["step"] for row in rows.rows] == [1, 3]
    # The first batch does not count: workers start, kernels are compiled.
    assert [row["time/compute"] for row in rows.rows] == pytest.approx([2.0, (3 + 4) / 2])
    assert [row["time/data"] for row in rows.rows] == pytest.approx([0.5, 0.5])
    assert [row["time/scenes_per_second"] for row in rows.rows] == pytest.approx([1 / 2.5, 2 / 8])
    assert all(0.1 < row["memory/process"] < 50 and "memory/gpu" not in row for row in rows.rows)


def test_a_step_of_several_batches_is_one_step(fit, clock):
    rows = Rows()
    accumulating = {"max_steps": 3, "log_every_n_steps": 3, "accumulate_grad_batches": 2}
    fit(Telemetry(), clock, experiment="stage1", loggers=rows, **accumulating)
    (row,) = rows.rows
    assert row["time/compute"] == pytest.approx((2 + 3 + 4 + 5 + 6) / 2.5)
    assert row["time/scenes_per_second"] == pytest.approx(5 / (20 + 5 * 0.5))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_memory_of_the_gpu(fit):
    rows = Rows()
    fit(Telemetry(), experiment="stage1", loggers=rows, max_steps=2, accelerator="gpu", devices=1)
    assert 0 < rows.rows[-1]["memory/gpu"] < 10


def test_the_learning_rate_is_logged_under_its_documented_name(fit):
    rows = Rows()
    fit(LearningRateMonitor(), experiment="stage1", loggers=rows, max_steps=4, log_every_n_steps=2)
    rates = [row["schedule/learning_rate"] for row in rows.rows if "schedule/learning_rate" in row]
    assert 0 < rates[0] < rates[1] < 1e-3


def test_settings_are_logged_at_the_start_and_the_score_once_at_the_end(fit, tmp_path):
    rows, board = Rows(), TensorBoardLogger(tmp_path, name="", version="")
    settings = RunSettings({"seed": 3}, metric="val/occupancy/iou")
    fit(settings, experiment="stage1", loggers=[rows, board], validate=1, max_steps=4, val_check_interval=2)
    assert rows.settings == {"seed": 3}
    events = EventAccumulator(str(tmp_path)).Reload()
    (score,) = events.Scalars(HP_METRIC)
    assert score.value == events.Scalars("val/occupancy/iou")[-1].value
    assert "_hparams_/session_start_info" in events.summary_metadata


def test_a_metric_that_was_not_logged_is_no_score(fit, tmp_path):
    board = TensorBoardLogger(tmp_path, name="", version="")
    fit(RunSettings({"seed": 3}, metric="val/none"), experiment="stage1", loggers=board, max_steps=1)
    assert HP_METRIC not in EventAccumulator(str(tmp_path)).Reload().Tags()["scalars"]


def test_columns_of_the_table_start_with_what_differs(fit, tmp_path):
    settings = {"model": {"_target_": "raytran.model.RayTran", "width": 3}, "seed": 1, "views": {"num": 2}}
    board = TensorBoardLogger(tmp_path, name="", version="")
    shown = RunSettings(settings, metric="train/total", first=["views", "seed", "absent"])
    fit(shown, experiment="stage1", loggers=board, max_steps=1)
    events = EventAccumulator(str(tmp_path)).Reload()
    content = events.summary_metadata["_hparams_/experiment"].plugin_data.content
    columns = HParamsPluginData.FromString(content).experiment.hparam_infos
    assert [column.name for column in columns] == ["views.num", "seed", "model.width"]
