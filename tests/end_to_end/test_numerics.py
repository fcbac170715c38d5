# SPDX-License-Identifier: Apache-2.0
"""Settings of the machine, not of the network: exactness of float32, determinism, shared memory."""

from __future__ import annotations

from collections import namedtuple

import pytest
import torch

from raytran.errors import ConfigError
from raytran.training import datamodule
from raytran.training.lightning_module import Reconstruction

from .runs import fit

SHORT = ["trainer.max_steps=1", "trainer.val_check_interval=1", "init_from=none"]


@pytest.fixture
def flags(monkeypatch):
    """What torch's switches are in each training step; afterwards they are as before."""
    seen = []
    step = Reconstruction.training_step
    before = torch.get_float32_matmul_precision(), torch.backends.cudnn.benchmark

    def watched(self, *arguments):
        seen.append(
            {
                "deterministic": torch.are_deterministic_algorithms_enabled(),
                "warn": torch.is_deterministic_algorithms_warn_only_enabled(),
                "benchmark": torch.backends.cudnn.benchmark,
                "precision": torch.get_float32_matmul_precision(),
            }
        )
        return step(self, *arguments)

    monkeypatch.setattr(Reconstruction, "training_step", watched)
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # Lightning sets it
    yield seen
    torch.use_deterministic_algorithms(False)
    torch.set_float32_matmul_precision(before[0])
    torch.backends.cudnn.benchmark = before[1]


@pytest.mark.parametrize("experiment", ["stage1", "stage2", "stage3", "novel_view"])
def test_every_stage_trains_with_deterministic_operations_alone(experiment, settings, flags, tmp_path):
    fit([*settings, *SHORT], tmp_path, f"experiment={experiment}", "trainer.deterministic=true")
    assert [(seen["deterministic"], seen["warn"]) for seen in flags] == [(True, False)]


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ([], {"deterministic": False, "warn": False, "benchmark": False, "precision": "highest"}),
        (["trainer.deterministic=warn"], {"deterministic": True, "warn": True}),
        (["trainer.benchmark=true"], {"benchmark": True}),
        (["matmul_precision=high"], {"precision": "high"}),
    ],
)
def test_switches_of_torch_are_as_the_run_says(typed, expected, settings, flags, tmp_path):
    fit([*settings, *SHORT], tmp_path, *typed)
    assert expected.items() <= flags[0].items()


@pytest.mark.parametrize("typed", ["trainer.deterministic=maybe", "matmul_precision=low"])
def test_a_switch_that_does_not_exist_is_one_sentence(typed, settings, tmp_path):
    with pytest.raises(ConfigError, match=f"unknown {typed}: choose "):
        fit([*settings, *SHORT], tmp_path, typed)


WATCHED = (
    "import atexit, torch; atexit.register(lambda: print('float32 is', torch.get_float32_matmul_precision()))"
)


@pytest.mark.parametrize("typed", [[], ["matmul_precision=high"], ["matmul_precision=low"]])
@pytest.mark.parametrize("name", ["train", "evaluate", "predict"])
def test_commands_agree_on_what_float32_is(name, typed, command, settings, rooms, tmp_path):
    words = {
        "train": [*settings, *SHORT],
        "evaluate": ["checkpoint=default", f"data.root={rooms}", "device=cpu", "num_views=2"],
        "predict": [
            f"scene={rooms / 'scannet' / 'scans' / 'scene0000_00'}",
            "output=prediction",
            "device=cpu",
            "num_views=2",
            "viewer=false",
            "turntable=0",
            "num_overlays=0",
            "check=false",
        ],
    }[name]
    done = command(name, *words, *typed, folder=tmp_path, first=WATCHED)
    if typed == ["matmul_precision=low"]:
        assert done.returncode == 1
        assert (
            "raytran: unknown matmul_precision=low: choose one of auto, highest, high, medium" in done.stderr
        )
        return
    assert done.returncode == 0, done.stderr
    assert f"float32 is {'high' if typed else 'highest'}" in done.stdout.splitlines()


Usage = namedtuple("Usage", "total used free")


@pytest.mark.parametrize(("free", "warns"), [(64 << 20, False), (100_000, True)])
def test_shared_memory_that_cannot_hold_the_scenes_is_told(
    free, warns, settings, monkeypatch, tmp_path, caplog
):
    """Scenes of three images of 64 × 64 and their masks, 49 kB and some; Docker gives 64 MB."""
    monkeypatch.setattr(datamodule, "SHARED_MEMORY", tmp_path)
    monkeypatch.setattr(datamodule.shutil, "disk_usage", lambda path: Usage(free, 0, free))
    more = ["views.num_workers=1", "views.batch_size=2", "experiment=stage2"]
    fit([*settings, *SHORT], tmp_path / "run", *more)
    told = [record.getMessage() for record in caplog.records if "--shm-size" in record.getMessage()]
    assert len(told) == warns
    if warns:  # two batches ahead, of two scenes in training and of one in validation
        assert f"may hold 6 scenes, 0.0003 GB, in {tmp_path}, which has 0.0001 GB free" in told[0]


def test_without_workers_shared_memory_does_not_matter(settings, monkeypatch, tmp_path, caplog):
    monkeypatch.setattr(datamodule.shutil, "disk_usage", lambda path: Usage(0, 0, 0))
    fit([*settings, *SHORT], tmp_path / "run", "views.num_workers=0")
    assert "--shm-size" not in caplog.text
