# SPDX-License-Identifier: Apache-2.0
"""Ranks end together: with processes that play them, since those of Lightning take seconds to start.

Real ones are killed in ``tests/end_to_end/test_lost_ranks.py``.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from torch import distributed as dist

from raytran.data.workers import ENDS_WITH
from raytran.errors import DataError
from raytran.run.train.rank_processes import LostRankError, rank_processes
from raytran.training.callbacks.stop_signals import StopRequestedError

CLOSED = "[/pytorch/third_party/gloo/gloo/transport/tcp/pair.cc:534] Connection closed by peer [127.0.0.1]:3"


@pytest.fixture
def trainer(monkeypatch):
    """A trainer with two ranks, of which the second sleeps."""
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    strategy = SimpleNamespace(launcher=SimpleNamespace(procs=[process]))
    yield SimpleNamespace(world_size=2, global_rank=0, strategy=strategy)
    process.kill()
    process.wait()


def fail(trainer, error):
    with rank_processes(trainer):
        raise error


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError(CLOSED),
        RuntimeError("NCCL communicator was aborted on rank 0"),
        dist.DistNetworkError("failed to recv, got 0 bytes"),
        dist.DistStoreError("Timed out after 1801 seconds waiting for clients. 1/2 clients joined."),
    ],
)
def test_the_loss_of_a_rank_is_one_sentence_and_the_others_are_ended(trainer, error):
    with pytest.raises(LostRankError, match=r"^another rank of this run has ended: .*resume=auto") as raised:
        fail(trainer, error)
    assert len(str(raised.value)) <= 300
    assert trainer.strategy.launcher.procs[0].wait(5) < 0


def test_other_errors_are_left_as_they_are_and_end_the_other_ranks(trainer):
    for error in (RuntimeError("shapes do not match"), DataError(f"{CLOSED}: not what it seems")):
        with pytest.raises(type(error)) as raised:
            fail(trainer, error)
        assert raised.value is error
    assert trainer.strategy.launcher.procs[0].wait(5) < 0


def test_one_rank_alone_has_lost_none(trainer):
    trainer.world_size = 1
    with pytest.raises(RuntimeError, match="gloo"):
        fail(trainer, RuntimeError(CLOSED))


@pytest.mark.parametrize(
    "said",
    [
        "DataLoader worker (pid(s) 7, 8) exited unexpectedly",
        "DataLoader worker (pid 7) is killed by signal: Killed. ",
        "DataLoader worker (pid 7) is killed by signal: Bus error. It is possible that dataloader's workers "
        "are out of shared memory. Please try to raise your shared memory limit.",
    ],
)
def test_a_killed_loader_worker_is_one_sentence(trainer, said):
    trainer.world_size = 1
    with pytest.raises(DataError, match=r"a process that loads scenes was ended from outside.*num_workers"):
        fail(trainer, RuntimeError(said))


def test_ranks_that_stop_are_waited_for(trainer):
    (rank,) = trainer.strategy.launcher.procs = [
        subprocess.Popen([sys.executable, "-c", "import time; time.sleep(0.5)"])
    ]
    with pytest.raises(StopRequestedError):
        fail(trainer, StopRequestedError(15))
    assert rank.poll() == 0
    with rank_processes(trainer):
        assert os.environ[ENDS_WITH] == str(os.getpid())
    assert ENDS_WITH not in os.environ


WAIT_FOR_A_LOST_RANK = """
import subprocess, sys, time
from types import SimpleNamespace
from raytran.run.train.rank_processes import rank_processes

ranks = [subprocess.Popen([sys.executable, "-c", f"import time; time.sleep({t}); exit({c})"])
         for t, c in ((0.5, 3), (90, 0))]
print(ranks[1].pid, flush=True)
launcher = SimpleNamespace(procs=ranks)
trainer = SimpleNamespace(world_size=3, global_rank=0, strategy=SimpleNamespace(launcher=launcher))
with rank_processes(trainer):
    time.sleep(90)  # as in a collective of NCCL
"""


def test_a_rank_that_waits_for_a_lost_one_is_ended(tmp_path):
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", WAIT_FOR_A_LOST_RANK], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 1
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith("raytran: another rank of this run has ended")
    assert time.monotonic() - began < 50
    with pytest.raises(ProcessLookupError):
        os.kill(int(done.stdout), 0)
