# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import csv
import json
import resource
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from raytran.training.history import read_history
from raytran.training.loggers import (
    WANDB_ID,
    MetricsTable,
    group_and_job,
    tensorboard_logger,
    wandb_logger,
)


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
    assert read_history(path.parent) == {"a": [(0, 1.0), (1, 0.1 + 0.2), (2, 4.0)], "b": [(1, 3.0), (2, 5.0)]}
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
    assert read_history(path.parent) == {"a": [(0, 1.0), (2, 3.0)]}


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
    assert read_history(path.parent)["a"] == [(0, 1.0), (1, 2.0), (2, 3.0), (3, 4.0)]


@contextmanager
def largest_file(size):
    """Refuse to let a file grow beyond a size, in the middle of a write, as a full disk does."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


@pytest.mark.parametrize("left", range(0, 60, 7))
def test_a_column_that_came_on_a_full_disk_gets_its_name(path, left, caplog):
    table = MetricsTable(path)
    log(table, (0, {"a": 1.0}), (1, {"a": 2.0}))
    before = path.read_text()
    with largest_file(len(before) + left):
        log(table, (2, {"a": 3.0, "first_validation": 0.25, "another_name": 0.5}))
        log(table, (3, {"a": 4.0}), (4, {"b": 5.0}))
        # A watcher reads whole rows under their names, or those from before.
        assert read_history(path.parent)["a"][:2] == [(0, 1.0), (1, 2.0)]
        assert len(caplog.messages) <= 1
    log(table, (5, {"a": 6.0}))
    assert read_history(path.parent) == {
        "a": [(0, 1.0), (1, 2.0), (2, 3.0), (3, 4.0), (5, 6.0)],
        "another_name": [(2, 0.5)],
        "b": [(4, 5.0)],
        "first_validation": [(2, 0.25)],
    }
    assert len(path.read_text().splitlines()) == 7
    assert [file.name for file in path.parent.iterdir()] == ["metrics.csv"]


@pytest.mark.parametrize("left", range(25))
def test_a_row_that_did_not_fit_is_written_whole_later(path, left):
    table = MetricsTable(path)
    log(table, (0, {"a": 1.0, "b": 1.0}))
    before = path.read_text()
    with largest_file(len(before) + left):
        log(table, (1, {"a": 0.123456, "b": 2.0}))
    log(table, (2, {"a": 3.0, "b": 4.0}))
    lines = ["step,epoch,a,b", "0,,1.0,1.0", "1,,0.123456,2.0", "2,,3.0,4.0"]
    assert path.read_text().splitlines() == lines


def test_a_table_of_an_earlier_version_that_lacks_a_name_is_read_and_continued(path):
    path.parent.mkdir()
    path.write_text("step,epoch,a\n0,0,1.0\n1,0,2.0,7.5\n,,9.0\n2,0,3.")
    assert read_history(path.parent) == {"a": [(0, 1.0), (1, 2.0)]}
    table = MetricsTable(path)
    table.continue_from(2)
    log(table, (2, {"a": 3.0, "b": 4.0}))
    assert read_history(path.parent) == {"a": [(0, 1.0), (1, 2.0), (2, 3.0)], "b": [(2, 4.0)]}


def test_no_table_is_an_empty_history(path):
    assert read_history(path.parent) == {}


def log_to_tensorboard(folder, values, continue_from=None):
    logger = tensorboard_logger(save_dir=str(folder))
    if continue_from is not None:
        logger.save()  # as Lightning does at the start, before the run is known to continue
        logger.continue_from(continue_from)
    for step, value in values.items():
        logger.log_metrics({"train/total": value}, step=step)
    logger.finalize("success")


def test_tensorboard_shows_steps_done_twice_once(tmp_path):
    log_to_tensorboard(tmp_path, {0: 9.0, 1: 8.0, 2: 7.0, 3: 6.0})
    log_to_tensorboard(tmp_path, {2: 7.5, 3: 6.5, 4: 5.5}, continue_from=2)
    assert {path.parent for path in tmp_path.rglob("events.out.tfevents.*")} == {tmp_path / "tensorboard"}
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload().Scalars("train/total")
    assert [(event.step, event.value) for event in events] == [
        *((0, 9.0), (1, 8.0)),
        *((2, 7.5), (3, 6.5), (4, 5.5)),
    ]


def test_a_run_goes_on_where_events_cannot_be_written(tmp_path, caplog, capsys):
    logger = tensorboard_logger(save_dir=str(tmp_path / "run"))
    logger.log_metrics({"a": 1.0}, step=0)
    logger.save()
    shutil.rmtree(tmp_path / "run")
    for step in range(1, 50):
        logger.log_metrics({"a": 1.0}, step=step)
        logger.save()
    logger.finalize("success")
    (said,) = caplog.messages
    assert "no more events for TensorBoard" in said
    assert capsys.readouterr().err == ""


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


def wandb_part(folder, *, online, monkeypatch):
    """Begin as a run or a resumed run does; return W&B's settings, and leave the folder that W&B would."""
    with monkeypatch.context() as context:
        if online:
            context.setenv("WANDB_API_KEY", "x" * 40)
        settings = wandb_logger(project="p", name="n", save_dir=str(folder))._wandb_init
    kind = "run" if online else "offline-run"
    (folder / "wandb" / f"{kind}-20260131_120000-{settings['id']}").mkdir(parents=True, exist_ok=True)
    return settings


@pytest.mark.usefixtures("no_wandb_settings")
@pytest.mark.parametrize(
    ("online", "runs"),
    [
        ([True, True, True], [1, 1, 1]),
        ([False, False, False], [1, 2, 3]),
        ([True, False, True, True], [1, 2, 3, 3]),
        ([False, True, True, False], [1, 2, 2, 3]),
    ],
)
def test_no_part_of_a_run_can_replace_another(online, runs, tmp_path, monkeypatch):
    folder = tmp_path / "stage1" / "monday"
    parts = [wandb_part(folder, online=is_online, monkeypatch=monkeypatch) for is_online in online]
    for run, part, is_online in zip(runs, parts, online, strict=True):
        assert part["id"] == parts[runs.index(run)]["id"]
        assert part["name"] == ("n" if run == 1 else f"n part {run}")
        assert part["resume"] == ("allow" if is_online else None)
        assert part["group"] == ("stage1 monday" if run > 1 or not is_online else None)
    assert len({part["id"] for part in parts}) == max(runs)


@pytest.mark.usefixtures("no_wandb_settings")
def test_wandb_mode_offline_is_offline(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_API_KEY", "x" * 40)
    monkeypatch.setenv("WANDB_MODE", "offline")
    assert wandb_logger(project="p", name="n", save_dir=str(tmp_path))._wandb_init["resume"] is None


def test_runs_of_a_sweep_or_a_curriculum_are_a_group(tmp_path):
    (tmp_path / "sweeps" / "monday").mkdir(parents=True)
    job = tmp_path / "sweeps" / "monday" / "0" / "stage1"
    assert group_and_job(job) == (None, "")
    (tmp_path / "sweeps" / "monday" / "0").mkdir()
    (tmp_path / "sweeps" / "monday" / "0" / "curriculum.json").touch()
    assert group_and_job(job) == ("monday 0", "stage1")
    names = ([["seed=1"], ["seed=2"]], "seed=1 stage1"), ([["seed=1"]] * 2, "0/stage1")
    for overrides, name in names:
        jobs = [{"overrides": own, "folder": str(number)} for number, own in enumerate(overrides)]
        record = {"command": ["curriculum"], "jobs": jobs}
        (tmp_path / "sweeps" / "monday" / "sweep.json").write_text(json.dumps(record))
        assert group_and_job(job) == ("sweeps monday", name)


def test_wandb_is_told_tags_and_no_setting_that_it_has_given_up(tmp_path):
    tags = ["tiny", "stage1", None, "tiny"]
    logger = wandb_logger(project="p", name="n", save_dir=str(tmp_path), tags=tags)
    assert logger._wandb_init["tags"] == ["tiny", "stage1"]
    assert "anonymous" not in logger._wandb_init
