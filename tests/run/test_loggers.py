# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from lightning.pytorch.loggers import CSVLogger

from raytran.run.loggers import LOGS, read_history


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
