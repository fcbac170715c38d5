# SPDX-License-Identifier: Apache-2.0
"""Two ranks of one scene take the steps that one rank of two scenes takes, in every stage."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch

from raytran.checkpoints.runs import LAST, read_finished
from raytran.run.entry import compose
from raytran.run.train.fit import train
from raytran.training.history import read_history

STAGES = ("stage1", "stage2", "stage3")
STEPS = 5


@pytest.fixture(scope="module")
def steps(settings):
    """Settings of five steps a stage, two scenes each."""
    return [item for item in settings if item != "trainer=cpu"] + [f"trainer.max_steps={STEPS}"]


@pytest.fixture(scope="module")
def curriculum(steps, tmp_path_factory, command):
    """The folder of a curriculum on two ranks of one scene."""
    folder = tmp_path_factory.mktemp("two")
    arguments = [*steps, "trainer=ddp_cpu", "views.batch_size=1", f"output_dir={folder}"]
    done = command("curriculum", *arguments, folder=folder, starts=len(STAGES))
    # Ranks that differ in a bit, at the start or the end of a stage or at a validation, stop the command.
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_two_ranks_train_the_network_that_one_rank_trains(stage, curriculum, steps, tmp_path):
    parent = [f"init_from={curriculum / STAGES[STAGES.index(stage) - 1] / LAST}"] if stage != "stage1" else []
    alone = ["trainer=cpu", "views.batch_size=2", f"experiment={stage}", f"output_dir={tmp_path}"]
    fit = train(compose("train", [*steps, *alone, *parent]))
    one, two = (torch.load(path, weights_only=True) for path in (fit.checkpoint, curriculum / stage / LAST))
    assert one["global_step"] == two["global_step"] == STEPS
    assert one["SceneDataModule"] == two["SceneDataModule"] == {"scenes": 2 * STEPS, "step": STEPS}
    assert set(one["state_dict"]) == set(two["state_dict"])
    # tests/training/test_ranks.py is exact, in float64. In float32 a ReLU's input close to zero rounds
    # to the one side here and to the other there, and of gradients so small AdamW makes steps.
    for name, value in one["state_dict"].items():
        assert (value - two["state_dict"][name]).double().abs().mean() <= 1e-5, name
    # One validation scene for two ranks: it comes twice and counts once.
    logs = [read_history(folder) for folder in (tmp_path, curriculum / stage)]
    assert set(logs[0]) == set(logs[1])
    for name in (name for name in logs[0] if name.startswith(("train/", "val/"))):
        (steps_one, values_one), (steps_two, values_two) = (zip(*log[name], strict=True) for log in logs)
        assert steps_one == steps_two, name
        assert values_one == pytest.approx(values_two, abs=1e-4), name


@pytest.mark.slow
def test_two_ranks_share_one_folder_a_stage(curriculum):
    assert [read_finished(curriculum / stage).steps for stage in STAGES] == [STEPS] * 3
    assert sorted(
        path.name for path in curriculum.iterdir() if path.is_dir() and path.name[0] != "."
    ) == list(STAGES)


@pytest.mark.slow
def test_ranks_share_the_batch_norms_of_voxels_too(steps, tmp_path, command):
    """The ranks' networks are compared at every validation; one that differs stops the command."""
    arguments = [*steps, "trainer=ddp_cpu", "variant=unprojection", "output_dir=run"]
    done = command("train", *arguments, folder=tmp_path, starts=1)
    assert done.returncode == 0, done.stderr
    state = torch.load(tmp_path / "run" / LAST, weights_only=True)["state_dict"]
    assert int(state["model.backbone.voxel_network.down.0.0.bn1.num_batches_tracked"]) == STEPS


NORMS_OF_THEIR_OWN = ("trainer=ddp_cpu", "experiment=stage1", "views.batch_size=1", "sync_norms=false")


@pytest.mark.slow
@pytest.mark.nightly
def test_ranks_take_two_passes_a_step(steps, tmp_path, command):
    """Then the strategy may not take the graph for a static one."""
    twice = ["trainer.accumulate_grad_batches=2", "trainer.max_steps=3", "output_dir=twice"]
    done = command("train", *steps, *NORMS_OF_THEIR_OWN, *twice, folder=tmp_path, starts=1)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_ranks_with_batch_norms_of_their_own_train_one_network(curriculum, steps, tmp_path, command):
    done = command("train", *steps, *NORMS_OF_THEIR_OWN, "output_dir=run", folder=tmp_path, starts=1)
    assert done.returncode == 0, done.stderr
    own, shared = (
        torch.load(folder / LAST, weights_only=True)["state_dict"]
        for folder in (tmp_path / "run", curriculum / "stage1")
    )
    assert own.keys() == shared.keys()
    name = next(name for name in own if name.endswith("running_var"))
    assert not torch.equal(own[name], shared[name])
    torch.testing.assert_close(own[name], shared[name], rtol=0.2, atol=0.05)


@pytest.mark.slow
@pytest.mark.nightly
def test_torchruns_ranks_share_one_folder(steps, tmp_path):
    """Each is a command of its own, with a clock of its own."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    cpu = ["trainer=ddp_multinode", "trainer.accelerator=cpu", "+trainer.strategy.process_group_backend=gloo"]
    done = subprocess.run(
        [*launcher, "-m", "raytran.train", *steps, *cpu, "views.batch_size=1", "trainer.max_steps=2"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    (run,) = (tmp_path / "outputs" / "tiny" / "stage1").iterdir()
    assert read_finished(run).steps == 2
    assert torch.load(run / LAST, weights_only=True)["SceneDataModule"] == {"scenes": 4, "step": 2}
    assert "2 scenes a step: 2 devices × 1 nodes" in done.stderr + done.stdout
