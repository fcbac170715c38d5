# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import re
import threading
from datetime import timedelta
from pathlib import Path

import pytest
from torch.distributed import TCPStore

from raytran.checkpoints.runs import first_ranks, name_by_time
from raytran.errors import ConfigError
from raytran.run.entry import compose

OF_LAUNCHERS = ("TORCHELASTIC", "SLURM_", "NODE_RANK", "GROUP_", "LOCAL_", "RANK", "WORLD_SIZE", "MASTER_")


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    """A process that nobody has launched."""
    for name in (name for name in os.environ if name.startswith(OF_LAUNCHERS)):
        monkeypatch.delenv(name)


@pytest.fixture
def torchrun(monkeypatch):
    """Return a function that makes this process one of torchrun's ranks."""
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False, timeout=timedelta(seconds=10))
    launched = {"TORCHELASTIC_RUN_ID": "1", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1"}
    for name, value in (launched | {"MASTER_PORT": str(store.port)}).items():
        monkeypatch.setenv(name, value)
    yield lambda rank: monkeypatch.setenv("RANK", str(rank))
    del store


def test_a_process_alone_chooses_itself():
    assert first_ranks("a folder", lambda: "mine") == "mine"


def test_other_ranks_take_what_the_first_has_chosen(torchrun, monkeypatch):
    torchrun(0)
    assert first_ranks("a folder", lambda: "of the first") == "of the first"
    torchrun(1)
    assert first_ranks("a folder", lambda: "of the second") == "of the first"
    # Restarted, the group chooses anew.
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "1")
    torchrun(0)
    assert first_ranks("a folder", lambda: "another") == "another"
    torchrun(1)
    assert first_ranks("a folder", lambda: "of the second") == "another"


def test_other_ranks_wait_for_the_first(torchrun):
    torchrun(1)
    found = []
    waiting = threading.Thread(target=lambda: found.append(first_ranks("a folder", lambda: "mine")))
    waiting.start()
    waiting.join(timeout=0.3)
    assert found == []
    store = TCPStore("127.0.0.1", int(os.environ["MASTER_PORT"]))
    store.set("raytran/0/a folder", "of the first")
    waiting.join(timeout=10)
    assert found == ["of the first"]


def test_what_the_first_rank_refuses_stops_all(torchrun):
    def refuse():
        raise ConfigError("resume=x is no run")

    for rank in (0, 1):
        torchrun(rank)
        with pytest.raises(ConfigError, match=r"^resume=x is no run$"):
            first_ranks("a folder", refuse)


def test_torchruns_numbers_are_the_trainers(monkeypatch, torchrun):
    torchrun(0)
    for name, value in {"GROUP_WORLD_SIZE": "3", "LOCAL_WORLD_SIZE": "4"}.items():
        monkeypatch.setenv(name, value)
    trainer = compose("train", ["trainer=ddp_multinode", "output_dir=unused"]).trainer
    assert (trainer.num_nodes, trainer.devices) == (3, 4)


def test_slurms_numbers_are_the_trainers_and_name_the_folder(monkeypatch):
    slurm = {
        "NNODES": "2",
        "NTASKS_PER_NODE": "8",
        "NTASKS": "16",
        "PROCID": "3",
        "JOB_ID": "71",
        "STEP_ID": "1",
    }
    for name, value in slurm.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    cfg = compose("train", ["trainer=ddp_multinode", "preset=raytran"])
    assert (cfg.trainer.num_nodes, cfg.trainer.devices) == (2, 8)
    assert Path(cfg.output_dir) == Path("outputs/raytran/stage1/job_71_1")


def test_nodes_started_by_hand_have_to_be_told(monkeypatch):
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d", name_by_time())
    monkeypatch.setenv("NODE_RANK", "1")
    with pytest.raises(ConfigError, match="give the same output_dir= to all"):
        name_by_time()
