# SPDX-License-Identifier: Apache-2.0
"""What the callback says of checkpoints it cannot continue exactly; tests/end_to_end resumes real runs."""

from __future__ import annotations

import random
from types import SimpleNamespace

import pytest
import torch

from raytran.errors import CheckpointError
from raytran.training.callbacks.last_checkpoint import LastCheckpoint
from raytran.training.checkpoint_resume import random_states


@pytest.fixture
def callback(tmp_path, monkeypatch):
    callback = LastCheckpoint(tmp_path / "last.ckpt", every_n_steps=5, metadata={})
    monkeypatch.setattr(callback._signals, "listen", lambda world_size: None)
    return callback


def trainer(**changes):
    values = {
        "global_step": 7,
        "world_size": 1,
        "global_rank": 0,
        "accumulate_grad_batches": 1,
        "loggers": [],
    }
    return SimpleNamespace(**{**values, **changes})


MODULE = SimpleNamespace(device=torch.device("cpu"))


def checkpoint(ranks=1, **changes):
    resume = {"validation_due": False, "random": [random_states(MODULE.device) for _ in range(ranks)]}
    return {
        "global_step": 7,
        "resume": resume,
        "optimizer_states": [],
        "lr_schedulers": [],
        "loops": {},
        **changes,
    }


def test_each_rank_gets_its_own_random_numbers(callback):
    content = checkpoint(2)
    random.seed(5)
    content["resume"]["random"][1] = random_states(MODULE.device)
    expected = random.random()
    callback.on_load_checkpoint(trainer(), MODULE, content)
    callback.on_train_start(trainer(world_size=2, global_rank=1), MODULE)
    assert random.random() == expected


def test_another_number_of_ranks_is_said(callback, caplog):
    callback.on_load_checkpoint(trainer(), MODULE, checkpoint(2))
    before = torch.get_rng_state()
    callback.on_train_start(trainer(world_size=1), MODULE)
    assert "had 2 ranks and has 1 now" in caplog.text
    assert torch.equal(torch.get_rng_state(), before)


def test_ranks_that_see_different_files_do_not_start(callback, monkeypatch):
    callback.on_load_checkpoint(trainer(), MODULE, checkpoint(2))
    monkeypatch.setattr(callback._signals, "gather", lambda step: [step, 3])
    with pytest.raises(CheckpointError, match=r"checkpoints of different steps \(\[7, 3\]\)"):
        callback.on_train_start(trainer(world_size=2), MODULE)


@pytest.mark.parametrize("changes", [{"resume": None}, {"resume": [1]}, {"global_step": "7"}])
def test_a_checkpoint_without_a_state_of_training_is_one_sentence(callback, changes):
    with pytest.raises(CheckpointError, match="no state of training: start a new run with init_from="):
        callback.on_load_checkpoint(trainer(), MODULE, checkpoint(**changes))


def test_before_the_first_step_there_is_nothing_to_count(callback):
    content = checkpoint(global_step=0)
    callback.on_load_checkpoint(trainer(), MODULE, content)
    assert "loops" not in content


def test_scores_are_kept_until_the_next_validation(callback):
    metrics = {"val/occupancy/iou": torch.tensor(0.25), "train/total": torch.tensor(1.0)}
    callback.on_validation_end(trainer(callback_metrics=metrics), MODULE)
    content = {}
    callback.on_save_checkpoint(trainer(), MODULE, content)
    assert content["scores"] == {"val/occupancy/iou": 0.25, "step": 7}
    resumed = LastCheckpoint(callback._path, every_n_steps=5, metadata={})
    resumed.on_load_checkpoint(trainer(), MODULE, checkpoint(scores=content["scores"]))
    later = {}
    resumed.on_save_checkpoint(trainer(), MODULE, later)
    assert later["scores"] == content["scores"]
