# SPDX-License-Identifier: Apache-2.0
"""Sweeps with a job that takes no time in place of training; tests/end_to_end/test_sweep.py trains."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

JOB = textwrap.dedent(
    """
    import json, os, pathlib, signal, sys, time
    settings = dict(word.partition("=")[::2] for word in sys.argv[1:])
    folder = pathlib.Path(settings["output_dir"].strip('"'))
    seed = int(settings["seed"])
    began = time.time()
    with (folder / "calls").open("a") as file:
        file.write(" ".join(sys.argv[1:]) + "\\n")
    kept = ("RANK", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS", "HYDRA_FULL_ERROR")
    ranks = {k: v for k, v in os.environ.items() if k.endswith(kept)}
    (folder / "environment.json").write_text(json.dumps(ranks))
    if seed > 90:
        sys.exit("raytran: " + os.environ["JOB_SAYS"].replace("SEED", str(seed)))
    if seed == 13 and not (folder.parent.parent / "mended").exists():
        sys.exit("thirteen is no seed")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    (folder / "pid").write_text(str(os.getpid()))
    # A job waits for what the test wants to happen first, and never for a time: machines differ in speed.
    awaited = [pathlib.Path(folder.parent, name) for name in os.environ.get("JOB_WAITS_FOR", "").split()]
    while not all(path.exists() for path in awaited):
        time.sleep(0.02)
    (folder / "metrics.csv").write_text(f"step,epoch,val/occupancy/iou\\n3,0,{seed / 10}\\n")
    mark = {"stage": "stage1", "preset": "tiny", "experiment": "stage1", "checkpoint": "x", "steps": 4}
    (folder / "finished.json").write_text(json.dumps({**mark, "time": "2026"}))
    (folder / "span.json").write_text(json.dumps([began, time.time()]))
    """
)
COMMAND = """
import sys
from raytran.run.sweep.job import Job
real = Job.command
Job.command = lambda job, general: [sys.executable, "job.py", *real(job, general)[3:]]
from raytran.train import main
main()
"""


@pytest.fixture
def sweep(tmp_path, command):
    """Run ``raytran train -m …`` in a folder of its own, with a script in place of each job."""
    (tmp_path / "job.py").write_text(JOB)
    (tmp_path / "command.py").write_text(COMMAND)

    def typed(words):
        many = [] if any(word.startswith("sweep=") for word in words) else ["-m"]
        return [*many, "preset=tiny", "trainer=cpu", *words]

    def start(*words, **environment):
        return subprocess.Popen(
            [sys.executable, "command.py", *typed(words)],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | environment,
        )

    def run(*words, **environment):
        done = command(str(tmp_path / "command.py"), *typed(words), folder=tmp_path, **environment)
        return done.returncode, done.stdout + done.stderr

    run.start, run.folder = start, tmp_path
    return run


def sweeps(run):
    return sorted((run.folder / "outputs" / "sweeps").iterdir())


def rows(folder):
    with (folder / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def calls(folder):
    path = folder / "calls"
    return path.read_text().splitlines() if path.is_file() else []


def started(run):
    """Return whether the first job has begun and minds signals."""
    return any(path.read_text() for path in run.folder.glob("outputs/sweeps/*/0/pid"))


def wait_for(condition):
    for _ in range(2400):
        if condition():
            return
        time.sleep(0.05)
    raise TimeoutError("waited two minutes for the sweep")


def test_each_job_has_a_folder_and_the_table_has_its_metric(sweep):
    code, said = sweep("seed=1,2", "hydra.verbose=false", RANK="0", LOCAL_RANK="0", WORLD_SIZE="1")
    assert code == 0, said
    (folder,) = sweeps(sweep)
    found = rows(folder)
    assert [(row["job"], row["seed"], row["status"]) for row in found] == [
        ("0", "1", "finished"),
        ("1", "2", "finished"),
    ]
    assert [(row["metric"], row["value"], row["steps"]) for row in found] == [
        ("val/occupancy/iou", "0.1", "4"),
        ("val/occupancy/iou", "0.2", "4"),
    ]
    assert "val/occupancy/iou = 0.2" in said
    assert "job 1 starts: seed=2 (2 of 2, " in said
    assert "1 of 2 jobs done, about " in said
    assert "all, 2 seeds: val/occupancy/iou = 0.15 ± 0.071" in said
    (call,) = calls(folder / "1")
    words = call.split()
    assert "seed=2" in words
    assert f'output_dir="{folder / "1"}"' in words
    # A job that was killed goes on, ten lines of progress are in its log, Hydra's own settings reach it.
    assert {"resume=auto", "progress_bar=rich", "hydra.verbose=false", "hydra.mode=RUN"} <= set(words)
    # No rank is left of whatever ran here before; nor what the launcher has set for itself.
    environment = json.loads((folder / "1" / "environment.json").read_text())
    assert not {"RANK", "LOCAL_RANK", "HYDRA_FULL_ERROR"} & set(environment)


def test_what_failed_runs_again_and_nothing_else(sweep):
    code, said = sweep("seed=1,13,3")
    assert code == 1
    assert "job 1 failed with exit code 1: thirteen is no seed" in said
    assert "Traceback" not in said
    assert "Error executing job" not in said, "Hydra's line before ours"
    assert said.strip().splitlines()[-1].startswith("raytran: job 1 failed (see ")
    assert [row["status"] for row in rows(sweeps(sweep)[0])] == ["finished", "failed", "finished"]
    (sweep.folder / "outputs" / "sweeps" / "mended").touch()
    code, said = sweep("seed=1,13,3", "launcher.parallel=2")
    assert code == 0, said
    (folder,) = [path for path in sweeps(sweep) if path.is_dir()]
    assert [len(calls(folder / number)) for number in "012"] == [1, 2, 1]
    assert [row["status"] for row in rows(folder)] == ["finished"] * 3
    assert [row["value"] for row in rows(folder)] == ["0.1", "1.3", "0.3"]


def test_what_two_jobs_fail_of_before_their_first_step_stops_the_sweep(sweep):
    code, said = sweep("seed=91,92,93,94", JOB_SAYS="there are no rooms in nowhere")
    assert code == 1
    assert "all fail of the same: jobs 2, 3 will not start" in said
    assert said.strip().splitlines()[-1] == (
        "raytran: there are no rooms in nowhere (jobs 0, 1 failed of this before the first step)"
    )
    statuses = ["failed", "failed", "not started", "not started"]
    assert [row["status"] for row in rows(sweeps(sweep)[0])] == statuses


def test_a_sweep_whose_jobs_all_lack_their_parent_starts_none(sweep):
    code, said = sweep("experiment=stage2", "seed=1,2,3")
    assert code == 1
    (line,) = said.strip().splitlines()
    assert line.startswith("raytran: no finished run of stage1 with preset tiny in outputs=outputs: run `")
    assert not (sweep.folder / "outputs").exists()


def test_a_named_folder_can_grow(sweep):
    folder = sweep.folder / "mine"
    sweep("seed=1,2", f"hydra.sweep.dir={folder}")
    code, said = sweep("seed=2,3", f"hydra.sweep.dir={folder}")
    assert code == 0, said
    assert [(row["job"], row["seed"]) for row in rows(folder)] == [("0", "1"), ("1", "2"), ("2", "3")]
    assert [len(calls(folder / number)) for number in "012"] == [1, 1, 1]


def test_jobs_run_side_by_side(sweep):
    # The first two can end only if both run at the same time.
    code, said = sweep("seed=1,2,3", "launcher.parallel=2", JOB_WAITS_FOR="0/pid 1/pid")
    assert code == 0, said
    (folder,) = sweeps(sweep)
    spans = [json.loads((folder / number / "span.json").read_text()) for number in "012"]
    assert spans[2][0] > min(spans[0][1], spans[1][1]), "the third waits for one of them"


def test_a_signal_stops_the_jobs_and_the_same_command_goes_on(sweep):
    process = sweep.start("seed=1,2", JOB_WAITS_FOR="never")
    wait_for(lambda: started(sweep))
    code, said = sweep("seed=1,2")
    assert code == 1
    assert "another process trains in" in said
    process.send_signal(signal.SIGTERM)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 143, said
    (folder,) = sweeps(sweep)
    assert [row["status"] for row in rows(folder)] == ["stopped", "not started"]
    code, said = sweep("seed=1,2")
    assert code == 0, said
    assert [len(calls(folder / number)) for number in "01"] == [2, 1]


@pytest.mark.nightly
def test_a_job_that_outlives_its_launcher_keeps_the_sweep(sweep):
    process = sweep.start("seed=1,2", JOB_WAITS_FOR="go")
    wait_for(lambda: started(sweep))
    process.kill()
    process.communicate()
    code, said = sweep("seed=1,2")
    assert (code, "another process trains in" in said) == (1, True), said
    (folder,) = sweeps(sweep)
    pid = int((folder / "0" / "pid").read_text())
    (folder / "go").touch()
    wait_for(lambda: not Path(f"/proc/{pid}").exists())  # the job has ended and let go of the lock
    code, said = sweep("seed=1,2")
    assert code == 0, said
    assert [len(calls(folder / number)) for number in "01"] == [1, 1]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("launcher.parallel=0", "launcher.parallel must be auto or at least 1, got 0"),
        ("trainer.num_nodes=2", "hydra/launcher=slurm"),
        ("hydra.launcher._target_=hydra_plugins.absent.Launcher", "it is not installed; pip install"),
    ],
)
def test_a_mistake_is_one_sentence(sweep, word, message):
    code, said = sweep("seed=1,2", word)
    assert code == 1
    assert message in said
    assert len(said.strip().splitlines()) == 1, said


def test_a_ready_sweep_by_name(sweep):
    code, said = sweep("sweep=seeds", "launcher.parallel=5")
    assert code == 0, said
    (folder,) = sweeps(sweep)
    assert [row["seed"] for row in rows(folder)] == ["0", "1", "2", "3", "4"]
    assert "sweep=" not in calls(folder / "3")[0], "a job is no sweep"
