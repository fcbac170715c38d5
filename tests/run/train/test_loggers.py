# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from raytran.run.train.loggers import METRICS, WANDB_ID, read_history, tensorboard_logger, wandb_logger
from raytran.training.metrics_table import MetricsTable


def test_a_run_logs_where_its_history_is_read(tmp_path):
    table = MetricsTable(tmp_path / METRICS)
    table.log_metrics({"train/total": 5.0}, step=0)
    table.save()
    assert read_history(tmp_path) == {"train/total": [(0, 5.0)]}


def test_no_log_is_an_empty_history(tmp_path):
    assert read_history(tmp_path) == {}


def log(folder, values, continue_from=None):
    logger = tensorboard_logger(save_dir=str(folder))
    if continue_from is not None:
        logger.save()  # as Lightning does at the start, before the run is known to continue
        logger.continue_from(continue_from)
    for step, value in values.items():
        logger.log_metrics({"train/total": value}, step=step)
    logger.finalize("success")


def test_tensorboard_shows_steps_done_twice_once(tmp_path):
    log(tmp_path, {0: 9.0, 1: 8.0, 2: 7.0, 3: 6.0})
    log(tmp_path, {2: 7.5, 3: 6.5, 4: 5.5}, continue_from=2)
    assert {path.parent for path in tmp_path.rglob("events.out.tfevents.*")} == {tmp_path / "tensorboard"}
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload().Scalars("train/total")
    assert [(event.step, event.value) for event in events] == [
        *((0, 9.0), (1, 8.0)),
        *((2, 7.5), (3, 6.5), (4, 5.5)),
    ]


@pytest.fixture
def no_wandb_settings(monkeypatch, tmp_path):
    for name in ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE", "WANDB_MODE", "WANDB_BASE_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))


@pytest.mark.usefixtures("no_wandb_settings")
def test_wandb_is_offline_without_a_key(tmp_path):
    assert wandb_logger(project="p", name="n", save_dir=str(tmp_path))._offline


@pytest.mark.usefixtures("no_wandb_settings")
@pytest.mark.parametrize("place", ["environment", "netrc"])
def test_wandb_is_online_with_a_key(tmp_path, monkeypatch, place):
    if place == "environment":
        monkeypatch.setenv("WANDB_API_KEY", "x" * 40)
    else:
        (tmp_path / "netrc").write_text("machine api.wandb.ai login user password key")
    logger = wandb_logger(project="p", name="n", save_dir=str(tmp_path))
    assert not logger._offline
    assert logger._wandb_init["resume"] == "allow"


@pytest.mark.usefixtures("no_wandb_settings")
def test_a_resumed_run_is_the_same_run(tmp_path):
    first = wandb_logger(project="p", name="n", save_dir=str(tmp_path / "a"))
    again = wandb_logger(project="p", name="n", save_dir=str(tmp_path / "a"))
    other = wandb_logger(project="p", name="n", save_dir=str(tmp_path / "b"))
    assert first.version == again.version == (tmp_path / "a" / WANDB_ID).read_text().strip()
    assert other.version != first.version
