# SPDX-License-Identifier: Apache-2.0
"""Ranks and loader workers that are killed, and scans that go away: one sentence, and no process is left."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.nightly

MOST_SECONDS = 12.0
"""Until all processes of a run have ended; measured: 5 on two idle cores."""


@pytest.fixture
def start(settings, rooms, tmp_path):
    """Start a training of many steps in a session of its own, on a copy of the rooms."""
    started = []
    shutil.copytree(rooms, tmp_path / "rooms")

    def start_training(*more):
        short = [item for item in settings if not item.startswith(("trainer", "data.root", "schedule.log"))]
        words = [*short, f"data.root={tmp_path / 'rooms'}", "trainer.max_steps=2000", "schedule.log_every=1"]
        words += ["trainer.val_check_interval=1000", "watch.pictures=0", "progress_bar=none", *more]
        with (tmp_path / "log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "raytran.train", *words, f"output_dir={tmp_path / 'run'}"],
                stdout=log,
                stderr=log,
                start_new_session=True,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            )
        started.append(process)
        return process

    yield start_training
    for process in started:
        for pid in session(process):
            os.kill(pid, signal.SIGKILL)
        process.wait()


def stat(pid):
    """State, parent and session of a process."""
    state, parent, _, of_session = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:4]
    return state, int(parent), int(of_session)


def session(process, *, but=()):
    """The processes of a command that still run."""
    found = []
    for path in Path("/proc").iterdir():
        try:
            state, _, of_session = stat(path.name) if path.name.isdigit() else ("Z", 0, 0)
        except OSError:
            continue
        if of_session == process.pid and state != "Z" and int(path.name) not in but:
            found.append(int(path.name))
    return found


def second_rank(process):
    """The command that Lightning has started, if it has."""
    for pid in session(process, but=[process.pid]):
        with_name = b"raytran.train" in Path(f"/proc/{pid}/cmdline").read_bytes()
        if with_name and stat(pid)[1] == process.pid and b"LOCAL_RANK=1" in environment(pid):
            return pid
    return None


def environment(pid):
    return Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")


def wait_for(condition, process):
    deadline = time.monotonic() + 120
    while not (found := condition()):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return found


def wait_for_steps(process, tmp_path):
    table = tmp_path / "run" / "metrics.csv"
    wait_for(lambda: table.is_file() and len(table.read_text().splitlines()) > 4, process)


def sentences_at_the_end(process, tmp_path):
    """What the command says, once all its processes have ended, which they do soon."""
    deadline = time.monotonic() + MOST_SECONDS
    while session(process):
        process.poll()
        assert time.monotonic() < deadline, session(process)
        time.sleep(0.05)
    text = (tmp_path / "log").read_text()
    assert "Traceback" not in text
    assert "Error" not in text
    return [line for line in text.splitlines() if line.startswith("raytran: ")]


@pytest.mark.parametrize("seconds", [0.0, 0.5, 2.0, 5.0, None])
@pytest.mark.parametrize("lost", ["first", "second"])
def test_a_rank_is_killed(start, tmp_path, lost, seconds):
    """Some seconds after the second one was started, or in the middle of training."""
    process = start("trainer=ddp_cpu", "views.batch_size=1", "views.num_workers=1")
    second = wait_for(lambda: second_rank(process), process)
    if seconds is None:
        wait_for_steps(process, tmp_path)
    else:
        time.sleep(seconds)
    os.kill(process.pid if lost == "first" else second, signal.SIGKILL)
    (sentence,) = sentences_at_the_end(process, tmp_path)
    said = (
        "the process that started this one has ended" if lost == "first" else "another rank of this run has"
    )
    assert sentence.startswith(f"raytran: {said}")
    assert process.wait() == (-signal.SIGKILL if lost == "first" else 1)


def test_a_loader_worker_is_killed(start, tmp_path):
    process = start("trainer=cpu", "views.num_workers=2")
    wait_for_steps(process, tmp_path)
    workers = [pid for pid in session(process, but=[process.pid]) if stat(pid)[1] == process.pid]
    os.kill(workers[-1], signal.SIGKILL)
    (sentence,) = sentences_at_the_end(process, tmp_path)
    assert "a process that loads scenes was ended from outside" in sentence


@pytest.mark.parametrize("trainer", ["cpu", "ddp_cpu"])
@pytest.mark.parametrize("workers", [0, 2])
def test_scans_are_deleted_while_they_are_read(start, tmp_path, trainer, workers):
    process = start(f"trainer={trainer}", "views.batch_size=1", f"views.num_workers={workers}")
    wait_for_steps(process, tmp_path)
    shutil.rmtree(tmp_path / "rooms" / "scannet" / "scans", ignore_errors=True)
    with_tracebacks = sentences_at_the_end(process, tmp_path)
    assert 1 <= len(with_tracebacks) <= (2 if trainer == "ddp_cpu" else 1)
    for sentence in with_tracebacks:
        assert str(tmp_path / "rooms") in sentence or "another rank" in sentence
        assert len(sentence) <= 300 + len("raytran: ")


@pytest.mark.parametrize("workers", [0, 2])
def test_ctrl_c_reaches_all_processes_and_leaves_none(start, tmp_path, workers):
    process = start("trainer=ddp_cpu", "views.batch_size=1", f"views.num_workers={workers}")
    wait_for_steps(process, tmp_path)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(60) == 130
    assert sentences_at_the_end(process, tmp_path) == []
    assert "resume=auto continues from step" in (tmp_path / "log").read_text()
