# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import csv
from pathlib import Path

import pytest

from raytran.training.metrics_table import MetricsTable, read_table


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run" / "metrics.csv"


def log(table, *entries):
    for step, metrics in entries:
        table.log_metrics(metrics, step=step)
        table.save()


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_rows_are_there_at_once_and_columns_may_come_later(path):
    table = MetricsTable(path)
    log(table, (0, {"a": 1.0, "epoch": 0}), (1, {"a": 0.1 + 0.2}))
    log(table, (1, {"b": 3.0}), (2, {"a": 4.0, "b": 5.0}))
    assert read_table(path) == {"a": [(0, 1.0), (1, 0.1 + 0.2), (2, 4.0)], "b": [(1, 3.0), (2, 5.0)]}
    assert rows(path)[0] == {"step": "0", "epoch": "0", "a": "1.0", "b": ""}


def test_a_resumed_run_goes_on_without_rows_that_come_twice(path):
    whole, stopped = MetricsTable(path), MetricsTable(path.with_name("stopped.csv"))
    entries = [(step, {"a": 1.0 / (step + 1)}) for step in range(6)]
    entries.insert(4, (3, {"val": 7.0}))
    log(whole, *entries)
    log(stopped, *entries[:6])  # steps 0 to 4; the checkpoint is of three steps
    resumed = MetricsTable(stopped.path)
    resumed.continue_from(3)
    log(resumed, *entries[3:])
    assert stopped.path.read_text() == path.read_text()


def test_a_new_run_starts_anew(path):
    log(MetricsTable(path), (0, {"a": 1.0}))
    table = MetricsTable(path)
    table.continue_from(0)
    assert rows(path) == []


def test_a_line_cut_short_by_a_kill_is_left_out(path):
    log(MetricsTable(path), (0, {"a": 1.0}), (1, {"a": 2.0}))
    path.write_text(path.read_text()[:-2])
    resumed = MetricsTable(path)
    resumed.continue_from(2)
    log(resumed, (2, {"a": 3.0}))
    assert read_table(path) == {"a": [(0, 1.0), (2, 3.0)]}


def test_a_full_disk_delays_rows(path, monkeypatch, caplog):
    table = MetricsTable(path)
    log(table, (0, {"a": 1.0}))
    with monkeypatch.context() as context:

        def refuse(*_, **__):
            raise OSError(28, "No space left on device")

        context.setattr(Path, "open", refuse)
        log(table, (1, {"a": 2.0}), (2, {"a": 3.0}))
    assert caplog.text.count("No space left on device): make room there; training goes on") == 1
    log(table, (3, {"a": 4.0}))
    assert read_table(path)["a"] == [(0, 1.0), (1, 2.0), (2, 3.0), (3, 4.0)]


def test_no_table_is_an_empty_history(path):
    assert read_table(path) == {}
