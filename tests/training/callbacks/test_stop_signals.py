# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal

import pytest
import torch.distributed as dist
import torch.multiprocessing as mp

from raytran.training.callbacks.stop_signals import SIGNALS, StopRequestedError, StopSignals


@pytest.fixture
def signals():
    earlier = {signum: signal.getsignal(signum) for signum in SIGNALS}
    found = StopSignals()
    found.listen(world_size=1)
    yield found
    for signum, handler in earlier.items():
        signal.signal(signum, handler)


@pytest.mark.parametrize("signum", SIGNALS)
def test_a_signal_is_remembered(signals, signum):
    assert signals.agreed() == 0
    os.kill(os.getpid(), signum)
    assert signals.agreed() == signals.agreed() == signum
    assert StopRequestedError(signum).args == (f"stopped by {signum.name}",)


def test_the_second_ctrl_c_stops_at_once(signals):
    os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)


def test_one_rank_speaks_for_itself(signals):
    assert signals.gather("a") == ["a"]


def _rank(rank, folder):
    dist.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    signals = StopSignals()
    signals.listen(world_size=2)
    heard = [signals.agreed()]
    if rank == 1:
        os.kill(os.getpid(), signal.SIGUSR1)
    heard.append(signals.agreed())
    (folder / str(rank)).write_text(f"{heard} {signals.gather({'rank': rank})}")
    dist.destroy_process_group()


@pytest.mark.slow
def test_all_ranks_hear_what_one_heard(tmp_path):
    mp.start_processes(_rank, args=(tmp_path,), nprocs=2, start_method="fork")
    said = {(tmp_path / str(rank)).read_text() for rank in range(2)}
    assert said == {f"[0, {int(signal.SIGUSR1)}] [{{'rank': 0}}, {{'rank': 1}}]"}
