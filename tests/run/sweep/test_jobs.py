# SPDX-License-Identifier: Apache-2.0
"""Which GPUs a job gets; what is read back of it. Processes themselves: test_launcher.py."""

from __future__ import annotations

import csv
import json
import sys
import textwrap

import pytest
from omegaconf import OmegaConf

from raytran.checkpoints.runs import write_finished
from raytran.checkpoints.sweeps import differences, read_record, varied_settings
from raytran.errors import ConfigError
from raytran.run.sweep.faults import said_by_all
from raytran.run.sweep.folder import last_value, own_settings, sweep_folder, write_record
from raytran.run.sweep.job import CONSOLE, FAILED, FINISHED, Job
from raytran.run.sweep.launcher import run_jobs
from raytran.run.sweep.results import RESULTS, write_results
from raytran.run.train.memory import TOO_SMALL

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
    return Job(number, (f"seed={number}", "preset=tiny"), folder / str(number), config)


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
    assert job(tmp_path, devices=devices, accelerator=accelerator).gpus_needed(4) == wanted


def test_no_two_jobs_share_a_gpu(tmp_path, monkeypatch, lock):
    monkeypatch.setattr(
        Job, "command", lambda job, general: [sys.executable, "-c", WRITES_WHAT_IT_SEES, str(job.folder)]
    )
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    jobs = [job(tmp_path, number, devices) for number, devices in enumerate((2, 1, 2, 3))]
    assert run_jobs(jobs, ["3", "5", "7"], [], lock, limit=3) == 0
    assert [item.status for item in jobs] == [FAILED] * 4, "they leave no mark of a finished run"
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


def finish(job):
    """Leave what a finished run leaves: a mark and a table of metrics."""
    job.folder.mkdir()
    write_finished(job.folder, stage="stage1", preset="tiny", experiment="stage1", steps=4)
    (job.folder / "metrics.csv").write_text(f"step,epoch,val/total,train/x\n2,0,0.{job.number}5,1\n")
    job.status = FINISHED
    return job


def record(folder, jobs):
    listed = [{"overrides": list(item.overrides), "folder": item.folder.name} for item in jobs]
    write_record(folder, "train", ["seed=0,1"], listed)


def test_a_metric_that_nobody_logged_is_named(tmp_path, caplog):
    done = finish(job(tmp_path))
    done.config.optimized_metric = "val/else"
    record(tmp_path, [done])
    assert write_results(tmp_path, [done]) == {0: None}
    assert "job 0 logged no val/else: optimized_metric can be val/total" in caplog.text


def test_results_have_every_job_of_the_sweep_whichever_call_has_run_it(tmp_path, caplog):
    caplog.set_level("INFO", "raytran")
    earlier, failed, never = finish(job(tmp_path)), job(tmp_path, 1), job(tmp_path, 2)
    failed.status = FAILED
    record(tmp_path, [earlier, failed, never])
    assert write_results(tmp_path, [failed]) == {0: 0.05, 1: None, 2: None}
    with (tmp_path / RESULTS).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["seed"], row["status"], row["value"], row["steps"]) for row in rows] == [
        ("0", "finished", "0.05", "4"),
        ("1", "failed", "", ""),
        ("2", "not started", "", ""),
    ]
    assert rows[0]["preset"] == "tiny"
    assert "job 0: seed=0 finished, val/total = 0.05" in caplog.text, "what all jobs share says nothing"


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


def test_what_tells_jobs_apart():
    jobs = [{"overrides": ["seed=1", "preset=tiny", "data.root=a"], "folder": "0"}]
    command = ["train", "data.root=a", "preset=tiny", "seed=1,2"]
    assert differences({"command": command, "jobs": jobs}) == [["seed=1"]]
    jobs.append({"overrides": ["seed=2", "preset=tiny", "data.root=a"], "folder": "1"})
    assert differences({"command": ["train", "sweep=mine"], "jobs": jobs}) == [["seed=1"], ["seed=2"]]


def test_what_jobs_vary_is_known_in_their_folders(tmp_path):
    jobs = [{"overrides": [f"seed={n}", f"+views.num_views={n}"], "folder": str(n)} for n in range(2)]
    write_record(tmp_path, "train", ["seed=0,1"], jobs)
    assert varied_settings(tmp_path / "1" / "stage2") == ["seed", "views.num_views"]
    assert varied_settings(tmp_path.parent / "elsewhere") == []
    (tmp_path / "sweep.json").write_text("{}")
    assert varied_settings(tmp_path / "1") == []


def test_the_spread_over_seeds_is_that_of_jobs_alike_in_all_else(tmp_path, caplog):
    caplog.set_level("INFO", "raytran")
    jobs = []
    for number, (rate, seed) in enumerate((rate, seed) for rate in ("1e-3", "1e-4") for seed in (0, 1, 2)):
        one = job(tmp_path, number)
        one.overrides = (f"optimizer.learning_rate={rate}", f"seed={seed}")
        jobs.append(finish(one))
    record(tmp_path, jobs)
    write_results(tmp_path, jobs)
    # 0.05, 0.15, 0.25 and 0.35, 0.45, 0.55
    assert "optimizer.learning_rate=1e-3, 3 seeds: val/total = 0.15 ± 0.1" in caplog.text
    assert "optimizer.learning_rate=1e-4, 3 seeds: val/total = 0.45 ± 0.1" in caplog.text


def failed(folder, number, said):
    one = job(folder, number)
    one.folder.mkdir()
    (one.folder / CONSOLE).write_text(f"[12:00:00] a line\n{said}\n")
    one.status = FAILED
    return one


@pytest.mark.parametrize(
    ("said", "shared"),
    [
        (("raytran: no rooms", "raytran: no rooms"), "no rooms"),
        (("raytran: no rooms",), None),
        (("raytran: no rooms in a", "raytran: no rooms in b"), None),
        (("KeyError: 3", "KeyError: 3"), None),
        ((f"raytran: memory {TOO_SMALL}", f"raytran: memory {TOO_SMALL}"), None),
    ],
)
def test_when_jobs_share_a_fault(tmp_path, said, shared):
    jobs = [failed(tmp_path, number, line) for number, line in enumerate(said)]
    assert said_by_all([*jobs, job(tmp_path, 9)]) == shared


def test_a_fault_is_not_shared_once_a_job_has_taken_a_step(tmp_path):
    jobs = [failed(tmp_path, number, "raytran: no rooms") for number in range(2)]
    assert said_by_all(jobs) == "no rooms"
    (jobs[1].folder / "metrics.csv").write_text("step,epoch,train/total\n0,0,1.5\n")
    assert said_by_all(jobs) is None
