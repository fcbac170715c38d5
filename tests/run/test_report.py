# SPDX-License-Identifier: Apache-2.0
"""Which runs are found, what is said of them, and what becomes of those that cannot be read."""

from __future__ import annotations

import json

import pytest

from raytran.checkpoints.runs import write_finished
from raytran.errors import ConfigError, DataError
from raytran.run.entry import compose
from raytran.run.report import find_runs, read_runs, report, training_seconds

TABLE = """step,epoch,train/total,time/data,time/compute,time/scenes_per_second,memory/process
0,0,9.0,,,,1.5
1,0,8.0,0.5,1.5,1.0,1.6
3,0,7.0,0.1,0.9,3.0,1.7
"""
CONFIG = """preset: tiny
seed: {seed}
output_dir: /somewhere/{seed}
stage: {{name: stage2}}
trainer: {{max_steps: 10}}
"""


def write_run(folder, seed=0, table=TABLE):
    folder.mkdir(parents=True)
    (folder / "metrics.csv").write_text(table)
    (folder / "config.yaml").write_text(CONFIG.format(seed=seed))
    origin = {"machine": "2 cores", "versions": {"torch": "2.13.0"}, "git_commit": "0123456789"}
    (folder / "provenance.json").write_text(json.dumps(origin))
    return folder


def test_runs_below_a_folder_are_found_once(tmp_path):
    first, second = (write_run(tmp_path / "sweep" / name) for name in ("a", "b"))
    assert find_runs([tmp_path / "sweep", second]) == [first.resolve(), second.resolve()]


def test_what_is_said_of_a_run(tmp_path):
    write_run(tmp_path / "sweep" / "a")
    done = write_run(tmp_path / "sweep" / "b" / "stage2", seed=1)
    write_finished(done, stage="stage2", preset="tiny", experiment="stage2", steps=4)
    (a, b), notes = read_runs(find_runs([tmp_path / "sweep"]))
    assert notes == []
    assert (a.name, b.name) == ("a", "b/stage2")
    assert a.facts == {
        "stage": "stage2",
        "preset": "tiny",
        "steps": "4 of 10",
        "state": "not finished",
        "time in steps": "6.0 s",
        "scenes/s": "2.00",
        "memory": "1.7 GB",
        "machine": "2 cores",
        "torch": "2.13.0",
        "commit": "0123456",
    }
    assert b.facts["steps"] == "4"
    assert b.facts["state"].startswith("finished 20")
    assert a.settings == {"preset": "tiny", "seed": 0, "stage.name": "stage2", "trainer.max_steps": 10}


def test_time_is_that_of_all_steps():
    history = {"time/data": [(1, 0.5), (3, 0.1)], "time/compute": [(1, 1.5), (3, 0.9)]}
    assert training_seconds(history) == pytest.approx(2 * 2.0 + 2 * 1.0)
    assert training_seconds({}) is None


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("metrics.csv", "step,train/total\n"),
        ("metrics.csv", "step,train/total\n1,many\n"),
        ("config.yaml", "a: [1"),
        ("provenance.json", "{"),
        ("finished.json", "{}"),
    ],
)
def test_a_run_that_cannot_be_read_is_left_out_and_named(name, text, tmp_path):
    write_run(tmp_path / "good")
    (write_run(tmp_path / "bad") / name).write_text(text)
    (record,), (note,) = read_runs(find_runs([tmp_path]))
    assert record.name == "good"
    assert note.startswith("bad is left out: ")
    page = report(compose("report", [f"runs=[{tmp_path}]", f"output={tmp_path / 'page.html'}"]))
    assert "bad is left out: " in page.read_text()


def test_nothing_to_compare_is_one_sentence(tmp_path):
    with pytest.raises(DataError, match=r"no folder .*gone: give the folder of a run"):
        find_runs([tmp_path / "gone"])
    with pytest.raises(DataError, match=r"holds no metrics\.csv"):
        find_runs([tmp_path])
    folder = write_run(tmp_path / "bad", table="step,train/total\n")
    with pytest.raises(DataError, match=r"none of the runs can be read: .*bad is left out"):
        read_runs([folder])


def test_a_page_that_cannot_be_written_is_one_sentence(tmp_path):
    write_run(tmp_path / "a")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="choose another output="):
        report(compose("report", [f"runs=[{tmp_path / 'a'}]", f"output={tmp_path / 'file' / 'page.html'}"]))
