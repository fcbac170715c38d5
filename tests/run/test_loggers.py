# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from raytran.run.loggers import METRICS, read_history, tensorboard_logger, wandb_logger
from raytran.training.metrics_table import MetricsTable


def test_a_run_logs_where_its_history_is_read(tmp_path):
    table = MetricsTable(tmp_path / METRICS)
    table.log_metrics({"train/total": 5.0}, step=0)
    table.save()
    assert read_history(tmp_path) == {"train/total": [(0, 5.0)]}


def test_no_log_is_an_empty_history(tmp_path):
    assert read_history(tmp_path) == {}


def test_tensorboard_writes_events(tmp_path):
    logger = tensorboard_logger(save_dir=str(tmp_path), name="tensorboard")
    logger.log_metrics({"train/total": 1.0}, step=0)
    logger.save()
    assert list(tmp_path.rglob("events.out.tfevents.*"))


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
    assert not wandb_logger(project="p", name="n", save_dir=str(tmp_path))._offline
