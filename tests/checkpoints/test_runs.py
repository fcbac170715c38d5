# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from raytran.checkpoints.file import LAST_NAME, PREVIOUS_NAME
from raytran.checkpoints.runs import (
    FINISHED,
    LAST,
    PREVIOUS,
    finished_runs,
    newest_unfinished,
    one_at_a_time,
    read_finished,
    run_folder,
    write_finished,
)
from raytran.errors import CheckpointError, ConfigError


def make_run(folder, *, stage="stage1", preset="tiny", finished=None, age=0.0):
    (folder / LAST).parent.mkdir(parents=True)
    (folder / LAST).touch()
    os.utime(folder / LAST, (1e9 - age, 1e9 - age))
    if finished is not None:
        write_finished(folder, stage=stage, preset=preset, experiment="stage1", steps=3)
        mark = json.loads((folder / FINISHED).read_text())
        (folder / FINISHED).write_text(json.dumps(mark | {"time": finished}))
    return folder


def test_a_mark_is_read_back(tmp_path):
    written = write_finished(tmp_path, stage="stage2", preset="small", experiment="stage2", steps=7)
    assert read_finished(tmp_path) == written
    assert (written.stage, written.preset, written.steps, written.checkpoint) == (
        "stage2",
        "small",
        7,
        LAST.as_posix(),
    )


def test_a_mark_says_what_the_run_was_trained_on(tmp_path):
    known = {"name": "rooms", "root": "data/rooms", "annotation": "ab12", "made": {"seed": 0}}
    names = {"stage": "stage2", "preset": "small", "experiment": "stage2", "steps": 7}
    assert write_finished(tmp_path, **names, data=known).data == known
    assert read_finished(tmp_path).data == known
    # One from before that was written down can be read too.
    mark = json.loads((tmp_path / FINISHED).read_text())
    del mark["data"]
    (tmp_path / FINISHED).write_text(json.dumps(mark))
    assert read_finished(tmp_path).data is None


def test_a_mark_of_an_earlier_version_is_of_the_stage_as_it_is_called_now(tmp_path):
    for old, new in (("occupancy", "stage1"), ("view", "novel_view"), ("mine", "mine")):
        write_finished(tmp_path, stage=old, preset="small", experiment="stage1", steps=7)
        assert read_finished(tmp_path).stage == new


def test_no_mark_is_none(tmp_path):
    assert read_finished(tmp_path) is None


def test_a_damaged_mark_is_one_sentence(tmp_path):
    (tmp_path / FINISHED).write_text('{"stage": "jo')
    with pytest.raises(CheckpointError, match=r"finished\.json is damaged: delete it"):
        read_finished(tmp_path)


def test_the_finished_runs_of_a_stage_are_found_newest_first(tmp_path):
    older = make_run(tmp_path / "tiny" / "stage1" / "a", finished="2026-01-03")
    newest = make_run(tmp_path / "tiny" / "curriculum" / "b" / "stage1", finished="2026-01-04")
    oldest = make_run(tmp_path / "tiny" / "stage1" / "c", finished="2026-01-01")
    make_run(tmp_path / "tiny" / "stage1" / "unfinished")
    make_run(tmp_path / "tiny" / "stage2" / "d", stage="stage2", finished="2026-01-05")
    make_run(tmp_path / "small" / "stage1" / "e", preset="small", finished="2026-01-06")
    found = finished_runs(tmp_path, preset="tiny", stage="stage1")
    assert [path for path, _ in found] == [newest / LAST, older / LAST, oldest / LAST]
    assert [mark.time for _, mark in found] == ["2026-01-04", "2026-01-03", "2026-01-01"]


def test_a_finished_run_without_its_checkpoint_does_not_count(tmp_path):
    run = make_run(tmp_path / "tiny" / "stage1" / "a", finished="2026-01-03")
    (run / LAST).unlink()
    assert finished_runs(tmp_path, preset="tiny", stage="stage1") == []


def test_the_newest_unfinished_run_is_found(tmp_path):
    make_run(tmp_path / "old", age=100.0)
    newest = make_run(tmp_path / "new", age=50.0)
    make_run(tmp_path / "finished", finished="2026-01-03")
    (tmp_path / "failed before its first checkpoint").mkdir()
    assert newest_unfinished(tmp_path, LAST) == newest
    assert newest_unfinished(tmp_path / "nothing", LAST) is None


def test_a_run_with_only_the_checkpoint_before_the_last_is_found(tmp_path):
    assert Path("checkpoints") / PREVIOUS_NAME == PREVIOUS
    assert Path("checkpoints") / LAST_NAME == LAST
    make_run(tmp_path / "old", age=100.0)
    newest = make_run(tmp_path / "new", age=50.0)
    (newest / LAST).rename(newest / PREVIOUS)
    assert newest_unfinished(tmp_path, LAST) == newest
    assert newest_unfinished(tmp_path, Path("curriculum.json")) is None


def test_one_process_a_folder(tmp_path):
    with (
        one_at_a_time(tmp_path / "run"),
        pytest.raises(ConfigError, match="another process trains in"),
        one_at_a_time(tmp_path / "run"),
    ):
        pass
    with one_at_a_time(tmp_path / "run"):
        pass


def test_resume_decides_the_folder(tmp_path):
    run = make_run(tmp_path / "tiny" / "stage1" / "a")
    assert run_folder(str(tmp_path), "tiny", "stage1", "auto") == str(run)
    assert run_folder(str(tmp_path), "tiny", "stage1", str(run / LAST)) == str(run)
    for resume, experiment in (("none", "stage1"), ("auto", "stage2")):
        fresh = run_folder(str(tmp_path), "tiny", experiment, resume)
        assert os.path.dirname(fresh) == str(tmp_path / "tiny" / experiment)
        assert not os.path.exists(fresh)


def test_resume_from_a_loose_file_is_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match=r"init_from=CHECKPOINT"):
        run_folder(str(tmp_path), "tiny", "stage1", "model.ckpt")


def test_a_parent_is_a_run_of_the_experiment_that_was_asked_for(tmp_path):
    run = make_run(tmp_path / "tiny" / "stage1" / "a", finished="2026-01-01")
    asked = {"preset": "tiny", "stage": "stage1"}
    assert [path for path, _ in finished_runs(tmp_path, experiment="stage1", **asked)] == [run / LAST]
    assert finished_runs(tmp_path, experiment="gt_masks_stage1", **asked) == []
