# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
from lightning.pytorch.loggers import CSVLogger

from raytran.run.loggers import LOGS, read_history, tensorboard_logger, wandb_logger


def write_log(folder, entries):
    logger = CSVLogger(save_dir=folder, name=LOGS)
    for step, metrics in entries:
        logger.log_metrics(metrics, step=step)
    logger.save()


def test_a_resumed_run_continues_its_curves(tmp_path):
    write_log(tmp_path, [(0, {"train/total": 5.0}), (10, {"train/total": 4.0}), (20, {"train/total": 3.0})])
    # Stopped after step 20, resumed from the checkpoint of step 10.
    write_log(tmp_path, [(20, {"train/total": 2.5}), (30, {"train/total": 2.0, "val/total": 7.0})])
    history = read_history(tmp_path)
    assert history["train/total"] == [(0, 5.0), (10, 4.0), (20, 2.5), (30, 2.0)]
    assert history["val/total"] == [(30, 7.0)]


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
