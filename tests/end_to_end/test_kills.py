# SPDX-License-Identifier: Apache-2.0
"""Commands that are killed or asked to stop at any moment, and given again.

``RAYTRAN_TEST_KILLS=10``, as ``make test-nightly`` has it, kills more often than two times. Runs that stop at
each hook of the Trainer, within one process, are in ``test_resume``.
"""

from __future__ import annotations

import logging
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from raytran.checkpoints.file import read_newest
from raytran.checkpoints.runs import FINISHED, LAST

from .runs import assert_same, table

pytestmark = pytest.mark.nightly

_log = logging.getLogger(__name__)

KILLS = int(os.environ.get("RAYTRAN_TEST_KILLS", "2"))


@pytest.fixture(scope="module")
def base(settings):
    short = [item for item in settings if not item.startswith(("trainer=", "schedule.log_every"))]
    more = [
        "trainer.val_check_interval=9",
        "checkpoint_every=5",
        "schedule.log_every=2",
        "resume=auto",
        "watch.pictures=0",
    ]
    return [*short, *more, "progress_bar=none"]


def start(name, folder, *arguments):
    """Start a command in a process group of its own, as a queue does."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_suffix(".log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", f"raytran.{name}", *arguments, f"output_dir={folder}"],
            stdout=log,
            stderr=log,
            start_new_session=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )


def finish(name, folder, *arguments):
    process = start(name, folder, *arguments)
    assert process.wait() == 0, folder.with_suffix(".log").read_text()
    assert (folder / FINISHED).is_file()


def wait_for_rows(process, table, count, timeout=120.0):
    """Wait until a table has grown by so many lines, or the command has ended."""
    deadline = time.monotonic() + timeout
    lines = len(table.read_text().splitlines()) if table.is_file() else 0
    while process.poll() is None and time.monotonic() < deadline:
        found = len(table.read_text().splitlines()) if table.is_file() else 0
        if found > 1 and found >= lines + count:
            return
        lines = min(lines, found)
        time.sleep(0.02)
    assert process.poll() is not None, "the command logged nothing"


def wait_and_kill(process, table, count, delay, signum=signal.SIGKILL):
    """Stop the whole group of a command some time after it has logged ``count`` further rows."""
    wait_for_rows(process, table, count)
    time.sleep(delay)
    if process.poll() is None:
        os.killpg(process.pid, signum)
    return process.wait()


def last_step(folder):
    found = read_newest((folder / LAST).parent)
    return 0 if found is None else found[1]["global_step"]


def test_killed_and_resumed_is_not_killed(base, tmp_path):
    arguments = [*base, "trainer=cpu", f"trainer.max_steps={40 + 20 * KILLS}"]
    straight, folder = tmp_path / "straight", tmp_path / "killed"
    finish("train", straight, *arguments)  # like the others: as many threads, so the same bits
    moments, steps = random.Random(0), []
    for _ in range(KILLS):
        process = start("train", folder, *arguments)
        code = wait_and_kill(
            process, folder / "metrics.csv", moments.randint(1, 8), moments.uniform(0.0, 0.3)
        )
        assert code == -signal.SIGKILL, folder.with_suffix(".log").read_text()
        steps.append(last_step(folder))
    _log.warning("killed when the last checkpoints were of steps %s", steps)
    assert steps == sorted(steps)
    assert steps[-1] > 0
    finish("train", folder, *arguments)
    assert_same(folder, straight)
    assert len(table(folder)) >= 10


def child_of(pid):
    """Return the process that Lightning started for the second rank."""
    return int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])


def test_a_curriculum_on_two_ranks_goes_on_after_a_signal_and_a_kill(base, tmp_path):
    arguments = [*base, "trainer=ddp_cpu", "trainer.max_steps=20"]
    straight, folder = tmp_path / "straight", tmp_path / "killed"
    finish("train", straight, *arguments)
    arguments.append("stages=[stage1]")
    stage = folder / "stage1"

    # A signal to the second rank alone: both stop after the same step and have saved it.
    process = start("curriculum", folder, *arguments)
    wait_for_rows(process, stage / "metrics.csv", 2)
    os.kill(child_of(child_of(process.pid)), signal.SIGUSR1)
    assert process.wait() == 1  # the curriculum's: its stage stopped
    text = folder.with_suffix(".log").read_text()
    assert f"stopped with exit code {128 + signal.SIGUSR1}" in text
    assert f"continues from step {last_step(stage)}" in text

    process = start("curriculum", folder, *arguments)
    assert wait_and_kill(process, stage / "metrics.csv", 2, 0.0) == -signal.SIGKILL
    assert 0 < last_step(stage) < 20
    finish("curriculum", folder, *arguments)
    assert_same(stage, straight)
    assert len(table(stage)) >= 10
