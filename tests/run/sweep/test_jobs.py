# SPDX-License-Identifier: Apache-2.0
"""Which GPUs a job gets; what is read back of it. Processes themselves: test_launcher.py."""

from __future__ import annotations

import json
import sys
import textwrap

import pytest
from omegaconf import OmegaConf

from raytran.checkpoints.runs import write_finished
from raytran.errors import ConfigError
from raytran.run.sweep.folder import last_value, own_settings, read_record, sweep_folder, write_record
from raytran.run.sweep.jobs import Job, JobPool
from raytran.run.sweep.table import FINISHED, FINISHED_BEFORE, JobResult, merged_rows, report

WRITES_WHAT_IT_SEES = textwrap.dedent(
    """
    import json, os, pathlib, sys, time
    folder = pathlib.Path(sys.argv[1])
    began = time.time()
    time.sleep(0.3)
    seen = [os.environ.get("CUDA_VISIBLE_DEVICES"), os.environ.get("OMP_NUM_THREADS"), began, time.time()]
    (folder / "seen.json").write_text(json.dumps(seen))
    """
)


def job(folder, number=0, devices=1, accelerator="gpu"):
    trainer = {"accelerator": accelerator, "devices": devices}
    config = OmegaConf.create({"trainer": trainer, "optimized_metric": "val/total"})
    return Job(number, (f"seed={number}",), folder / str(number), config, "train", f"seed={number}")


@pytest.mark.parametrize(
    ("devices", "accelerator", "wanted"),
    [
        (1, "gpu", 1),
        (8, "gpu", 4),
        (2, "auto", 2),
        ("auto", "gpu", 4),
        (-1, "gpu", 4),
        ([1, 3], "gpu", 4),
        (2, "cpu", 0),
    ],
)
def test_gpus_that_a_job_needs(tmp_path, devices, accelerator, wanted):
    assert job(tmp_path, devices=devices, accelerator=accelerator).gpus(4) == wanted


def test_no_two_jobs_share_a_gpu(tmp_path, monkeypatch, lock):
    monkeypatch.setattr(
        Job, "command", lambda job, general: [sys.executable, "-c", WRITES_WHAT_IT_SEES, str(job.folder)]
    )
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    jobs = [job(tmp_path, number, devices) for number, devices in enumerate((2, 1, 2, 3))]
    pool = JobPool(3, ["3", "5", "7"], [], lock)
    pool.run(jobs)
    seen = [json.loads((item.folder / "seen.json").read_text()) for item in jobs]
    assert [gpus for gpus, *_ in seen[:2]] == ["3,5", "7"]
    assert sorted(seen[3][0].split(",")) == ["3", "5", "7"]
    for i, (gpus, _, began, ended) in enumerate(seen):
        for other, _, other_began, other_ended in seen[:i]:
            apart = began >= other_ended or other_began >= ended
            assert apart or not set(gpus.split(",")) & set(other.split(","))
    assert seen[0][2] < seen[1][3], "the first two fit side by side"
    assert seen[1][2] < seen[0][3]
    assert all(threads is not None for _, threads, *_ in seen), "jobs side by side share the cores"


@pytest.fixture
def lock(tmp_path):
    with (tmp_path / "lock").open("w") as file:
        yield file.fileno()


def test_the_metric_of_a_run_and_of_a_curriculum(tmp_path):
    table = "step,epoch,val/total,val/objects/f1\n2,0,3.5,\n4,0,2.5,\n"
    (tmp_path / "metrics.csv").write_text(table)
    assert last_value(tmp_path, "val/total") == (2.5, ["val/total"])
    assert last_value(tmp_path, "val/else") == (None, ["val/total"])
    for number, name in enumerate(("stage2", "stage1")):  # the later stage by time, not by name
        stage = tmp_path / "both" / name
        stage.mkdir(parents=True)
        (stage / "metrics.csv").write_text(f"step,epoch,val/total\n2,0,{number}\n")
        write_finished(stage, stage="stage2", preset="tiny", experiment=name, steps=4)
    assert last_value(tmp_path / "both", "val/total")[0] == 1.0


def test_a_metric_that_nobody_logged_is_named(tmp_path, caplog):
    done = job(tmp_path)
    done.folder.mkdir()
    (done.folder / "metrics.csv").write_text("step,epoch,val/shape,train/shape\n2,0,1,1\n")
    assert done.result(FINISHED, 0).value is None
    assert "job 0 logged no val/total: optimized_metric can be val/shape" in caplog.text


def test_settings_of_the_sweep_are_not_the_jobs():
    typed = ["sweep=seeds", "launcher.parallel=2", "output_dir=x", "seed=1", "+new=2", "~gone"]
    assert own_settings(typed) == ["seed=1", "+new=2", "~gone"]


def test_a_sweep_is_found_by_what_was_typed(tmp_path):
    earlier = tmp_path / "sweeps" / "2026-01-01_00-00-00"
    earlier.mkdir(parents=True)
    write_record(earlier, "train", ["seed=1,2", "preset=tiny"], [{"overrides": ["seed=1"], "folder": "0"}])
    assert read_record(earlier)["jobs"] == [{"overrides": ["seed=1"], "folder": "0"}]

    def found(*words, program="train", resume="auto"):
        return sweep_folder(str(tmp_path), resume, program, words) == str(earlier)

    assert found("preset=tiny", "seed=1,2", "launcher.parallel=3")
    assert not found("preset=tiny", "seed=1,2,3")
    assert not found("preset=tiny", "seed=1,2", program="curriculum")
    assert not found("preset=tiny", "seed=1,2", resume="none")
    with pytest.raises(ConfigError, match="resume=maybe: choose auto or none"):
        found("seed=1,2", resume="maybe")
    (earlier / "sweep.json").write_text("{")
    with pytest.raises(ConfigError, match=r"sweep\.json is damaged: delete it"):
        found("preset=tiny", "seed=1,2")


def result(folder, number, status, **more):
    usual = {"exit_code": None, "metric": "val/total", "value": 0.25, "steps": 4, "seconds": 0.0}
    settings = (f"seed={number}", "preset=tiny")
    return JobResult(
        number=number, overrides=settings, folder=folder / str(number), status=status, **(usual | more)
    )


def test_the_table_keeps_what_earlier_calls_found(tmp_path, capsys):
    report(tmp_path, [result(tmp_path, n, FINISHED, exit_code=0, seconds=9.0) for n in (0, 1)])
    shown = capsys.readouterr().out
    assert "seed" in shown
    assert "preset" not in shown, "what all jobs share says nothing"
    report(tmp_path, [result(tmp_path, 1, FINISHED_BEFORE), result(tmp_path, 2, FINISHED, value=None)])
    rows = merged_rows(tmp_path, [])
    assert [(row["job"], row["status"], row["seconds"]) for row in rows] == [
        ("0", "finished", "9.0"),
        ("1", "finished", "9.0"),
        ("2", "finished", "0.0"),
    ]
    assert [row["value"] for row in rows] == ["0.25", "0.25", ""]
    assert rows[2]["preset"] == "tiny"
