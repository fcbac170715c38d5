# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time

import pytest

from raytran.data.workers import work_on
from raytran.errors import DataError


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
