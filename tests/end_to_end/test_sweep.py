# SPDX-License-Identifier: Apache-2.0
"""A sweep over numbers of devices, one of which fails; a row of the paper's tables."""

from __future__ import annotations

import csv
import json

import pytest

from raytran.checkpoints.runs import LAST

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def swept(settings, command, tmp_path_factory):
    """The folder in which the sweep was called, how it ended, and its jobs' folders."""
    folder = tmp_path_factory.mktemp("sweep")
    # Of two settings for one key the later counts: the trainer of these tests is not the one wanted here.
    shared = [item for item in settings if not item.startswith("trainer=")]
    words = ["-m", "trainer=ddp_cpu", "trainer.devices=1,0,2", "trainer.max_steps=2", *shared]
    words = [item for item in words if item != "trainer.max_steps=4"]
    done = command("train", *words, folder=folder, starts=3)
    (sweep,) = (folder / "outputs" / "sweeps").iterdir()
    return words, done, sweep


def rows(sweep):
    with (sweep / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_failing_job_does_not_stop_the_sweep(swept):
    _, done, sweep = swept
    assert done.returncode == 1
    assert [(row["trainer.devices"], row["status"]) for row in rows(sweep)] == [
        ("1", "finished"),
        ("0", "failed"),
        ("2", "finished"),
    ], done.stdout + done.stderr
    assert all(0 <= float(row["value"]) <= 1 for row in rows(sweep) if row["status"] == "finished")


def test_a_job_on_two_devices_trains_on_two_processes(swept):
    sweep = swept[2]
    # Each rank keeps a log of its own; Hydra's launcher would start no second rank after job 0.
    assert (sweep / "2" / "train_ddp_process_1.log").is_file()
    assert not list((sweep / "0").glob("train_ddp_process_*"))
    said = (sweep / "2" / "console.log").read_text()
    assert "2 devices" in said, said


def test_a_second_call_runs_only_what_failed(swept, command):
    words, _, sweep = swept
    before = {number: (sweep / number / "finished.json").read_bytes() for number in "02"}
    again = command("train", *words, folder=sweep.parents[2], starts=1)
    assert again.returncode == 1
    assert [path for path in sweep.parent.iterdir()] == [sweep], "one folder for both calls"
    assert {number: (sweep / number / "finished.json").read_bytes() for number in "02"} == before
    assert again.stdout.count(" starts: ") == 1
    assert "job 1 starts: trainer.devices=0" in again.stdout


def test_a_row_of_the_papers_tables_is_evaluated(swept, rooms, command):
    words = [f"checkpoint={swept[2] / '0' / LAST}", f"data.root={rooms}", "device=cpu", "num_views=4"]
    done = command("evaluate", *words, "max_objects=10", "output=few", folder=swept[2])
    assert done.returncode == 0, done.stderr
    assert json.loads((swept[2] / "few" / "metrics.json").read_text())["max_objects"] == 10
