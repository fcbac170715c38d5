# SPDX-License-Identifier: Apache-2.0
"""How far a sweep is said to be, by what its jobs have left in their folders."""

from __future__ import annotations

import pytest
from omegaconf import OmegaConf

from raytran.checkpoints.runs import write_finished
from raytran.run.sweep.job import FAILED, FINISHED, Job
from raytran.run.sweep.progress import SweepProgress, in_words


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def job(folder, number, **settings):
    config = OmegaConf.create({"optimized_metric": "val/iou", **settings})
    return Job(number, (f"seed={number}",), folder / str(number), config, title=f"seed={number}")


def log(run, *rows, steps=20):
    """Leave what a run of ``steps`` steps leaves that has logged these rows."""
    run.mkdir(parents=True, exist_ok=True)
    (run / "config.yaml").write_text(f"trainer:\n  max_steps: {steps}\n")
    (run / "metrics.csv").write_text("\n".join(["step,epoch,train/total,val/iou", *rows, ""]))


def finish(folder):
    write_finished(folder, stage="stage1", preset="tiny", experiment="stage1", steps=20)


def test_a_job_tells_its_step_its_loss_and_its_score(tmp_path):
    one = job(tmp_path, 1)
    assert one.standing() == (0.0, "starts")
    log(one.folder, "3,0,2.5,", "7,0,,0.25")
    assert one.standing() == (0.4, "step 8 of 20, loss 2.5, val/iou 0.25")
    finish(one.folder)
    assert one.standing() == (1.0, "finished")


def test_a_curriculum_tells_its_stage(tmp_path):
    one = job(tmp_path, 1, stages=["stage1", "stage2"])
    log(one.folder / "stage1", "19,0,1,")
    finish(one.folder / "stage1")
    log(one.folder / "stage2", "4,0,3,")
    assert one.standing() == (0.625, "stage2, step 5 of 20, loss 3")


def test_a_long_table_is_read_from_its_end(tmp_path):
    one = job(tmp_path, 1)
    log(one.folder, "0,0,9,0.9", *(f"{step},0,{step / 1000},0.5" for step in range(1, 40_000)), steps=80_000)
    assert (one.folder / "metrics.csv").stat().st_size > 2 * (1 << 18)
    assert one.standing() == (0.5, "step 40000 of 80000, loss 40, val/iou 0.5")


def test_the_time_that_is_left_follows_from_what_this_call_has_done(tmp_path, clock):
    jobs = [job(tmp_path, number) for number in range(4)]
    jobs[0].status = FINISHED
    log(jobs[0].folder)
    finish(jobs[0].folder)
    log(jobs[1].folder, "9,0,1,")  # half of it was done before
    progress = SweepProgress(jobs, clock=clock)
    assert (progress.count(), progress.left()) == ("1 of 4 jobs done", "")
    clock.now = 600.0
    log(jobs[1].folder, "19,0,1,")
    finish(jobs[1].folder)
    jobs[1].status = FINISHED
    progress.ended(jobs[1], [])
    assert progress.seconds_left() == pytest.approx(2 * 600 / 0.5)
    assert (progress.count(), progress.left()) == ("2 of 4 jobs done", ", about 40 min left")
    jobs[2].status = FAILED
    progress.ended(jobs[2], [])
    assert (progress.count(), progress.left()) == ("2 of 4 jobs done, 1 failed", ", about 20 min left")


def test_where_there_is_no_terminal_a_line_comes_at_most_once_a_minute(tmp_path, clock, caplog):
    caplog.set_level("INFO", "raytran")
    jobs = [job(tmp_path, 0), job(tmp_path, 1)]
    with SweepProgress(jobs, clock=clock) as progress:
        for clock.now in range(10, 130, 10):
            log(jobs[0].folder, f"{int(clock.now) // 10},0,1.5,")
            progress.look(jobs[:1])
    assert [record.message for record in caplog.records] == [
        "seed=0: step 7 of 20, loss 1.5",
        "0 of 2 jobs done, about 5 min left",
        "seed=0: step 13 of 20, loss 1.5",
        "0 of 2 jobs done, about 4 min left",
    ]


def test_who_wants_no_progress_gets_none(tmp_path, clock, caplog):
    caplog.set_level("INFO", "raytran")
    jobs = [job(tmp_path, 0)]
    with SweepProgress(jobs, silent=True, clock=clock) as progress:
        clock.now = 100.0
        log(jobs[0].folder, "9,0,1.5,")
        progress.look(jobs)
        progress.ended(jobs[0], [])
    assert not caplog.records


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.2, "1 s"), (40, "40 s"), (95, "2 min"), (2040, "34 min"), (7800, "2 h 10 min")]
)
def test_times_in_words(seconds, words):
    assert in_words(seconds) == words
