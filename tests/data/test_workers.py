# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gc
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from torch.utils.data import DataLoader

from raytran.checkpoints.file import DamagedCheckpointError
from raytran.data.workers import become_worker, work_on
from raytran.errors import ConfigError, DataError, ShapeError


def test_each_item_once_in_this_process():
    assert list(work_on([1, 4, 9], math.sqrt, label="x", processes=1, progress=False)) == [1, 2, 3]
    assert list(work_on([], math.sqrt, label="x", progress=False)) == []


def test_each_item_once_in_several_processes():
    before = os.environ.get("OMP_NUM_THREADS")
    results = list(work_on(range(20), math.sqrt, label="x", processes=2, progress=False))
    assert sorted(results) == [math.sqrt(n) for n in range(20)]
    assert os.environ.get("OMP_NUM_THREADS") == before


def test_few_quick_items_start_no_process():
    pids = list(work_on([None] * 5, pid_of_worker, label="x", processes=2, items_each=3, progress=False))
    assert set(pids) == {os.getpid()}


def pid_of_worker(_):
    return os.getpid()


def test_an_error_reaches_the_caller():
    with pytest.raises(ValueError, match=r"math domain error|nonnegative"):
        list(work_on([1, -1, 1], math.sqrt, label="x", processes=2, progress=False))


def test_a_worker_that_is_killed_is_one_sentence():
    with pytest.raises(DataError, match="smaller processes="):
        list(work_on([9, 9, 9], os._exit, label="x", processes=2, progress=False))


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="needs Linux to look at processes")
def test_processes_end_with_a_parent_that_is_killed(tmp_path):
    # They watch their parent once they have started to work, which a file says.
    mark = f"pathlib.Path({str(tmp_path)!r}, str(os.getpid())).touch()"
    work = f"import os, pathlib, time; {mark}; time.sleep(600)"
    code = (
        "from raytran.data.workers import work_on\n"
        "if __name__ == '__main__':\n"
        f"    list(work_on([{work!r}] * 2, exec, label='x', processes=2, progress=False))\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code])
    try:
        workers = wait_for(lambda: [int(path.name) for path in tmp_path.iterdir()], 2)
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    deadline = time.monotonic() + 60
    while any(running(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(running(pid) for pid in workers)


def wait_for(look, count):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        found = look()
        if len(found) >= count:
            return found
        time.sleep(0.05)
    raise TimeoutError


def running(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


CHILD = """
import sys, time
from multiprocessing import get_context
from raytran.data.workers import end_with_parent
if __name__ == "__main__":
    worker = get_context("fork").Process(target=time.sleep, args=(90,), daemon=True)
    worker.start()
    end_with_parent("the first has ended", parent=int(sys.argv[1]) if len(sys.argv) > 1 else None)
    print(worker.pid, flush=True)
    time.sleep(90)
"""

PARENT = f"""
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", {CHILD!r}])
print(child.pid, flush=True)
child.wait()
"""


def test_a_process_and_its_workers_end_with_the_parent_and_say_so():
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    pids = [int(parent.stdout.readline()) for _ in range(2)]
    parent.kill()
    began = time.monotonic()
    _, said = parent.communicate(timeout=60)  # until all have closed what they inherited
    assert said == "raytran: the first has ended\n"
    while any(is_running(pid) for pid in pids):
        assert time.monotonic() - began < 5


def test_a_process_whose_parent_has_ended_before_it_looks_ends_too():
    done = subprocess.run(
        [sys.executable, "-c", CHILD, "999999999"], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (1, "raytran: the first has ended\n")


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


class Scenes:
    """The second cannot be read."""

    def __init__(self, error):
        self.error = error

    def __len__(self):
        return 2

    def __getitem__(self, index):
        if index == 1:
            raise self.error
        return index


@pytest.mark.parametrize("kind", [DataError, ConfigError, DamagedCheckpointError, ShapeError])
def test_a_sentence_of_a_loaders_worker_keeps_its_kind_and_stays_one(kind):
    error = kind("cannot read the image a: b.jpg ([Errno 2] No such file): copy it again")
    with pytest.raises(kind) as raised:
        list(DataLoader(Scenes(error), num_workers=1, worker_init_fn=init_worker))
    assert str(raised.value) == str(error)
    assert type(raised.value) is kind
    del raised
    gc.collect()  # else PyTorch may end this loader in a worker of the next one, which takes ten seconds


def init_worker(_):
    become_worker()


def test_a_defect_in_a_loaders_worker_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError, match="Original Traceback"):
        list(DataLoader(Scenes(ZeroDivisionError()), num_workers=1))
