# SPDX-License-Identifier: Apache-2.0
"""What a run keeps of its best validation, when it ends early, and what it says of the next stage."""

from __future__ import annotations

import logging

import pytest
import torch

from raytran.checkpoints.file import BEST_NAME, read_checkpoint
from raytran.checkpoints.runs import LAST, read_finished
from raytran.errors import ConfigError
from raytran.run.entry import compose
from raytran.run.train.build import build_data, build_trainer, plain
from raytran.run.train.settings import RunConfig
from raytran.training.callbacks.stage import StageCallback
from raytran.training.lightning_module import Reconstruction

from .runs import fit


@pytest.fixture
def scored(monkeypatch):
    """Let validations say what a list says, one after the other."""

    def give(*values):
        left = list(values)

        def log(module):
            module.log_dict({"val/occupancy/iou": torch.tensor(left.pop(0))})
            module.scores.reset()
            module._val_losses.clear()

        monkeypatch.setattr(Reconstruction, "on_validation_epoch_end", log)

    return give


@pytest.fixture
def six_steps(settings):
    """A first stage that validates after each of six steps."""
    return [
        *settings,
        "experiment=stage1",
        "trainer.max_steps=6",
        "trainer.val_check_interval=1",
        "watch.pictures=0",
    ]


def test_the_best_weights_are_kept_beside_the_last(tmp_path, six_steps, scored):
    scored(0.1, 0.4, 0.2, 0.3, 0.1, 0.2)
    fit(six_steps, tmp_path)
    best, last = read_checkpoint((tmp_path / LAST).with_name(BEST_NAME)), read_checkpoint(tmp_path / LAST)
    assert (best["global_step"], last["global_step"]) == (2, 6)
    assert best["scores"]["val/occupancy/iou"] == pytest.approx(0.4)
    assert (best["stage"], best["format"]) == (last["stage"], last["format"])
    changed = [
        name for name, value in best["state_dict"].items() if not torch.equal(value, last["state_dict"][name])
    ]
    assert changed
    names = {path.name for path in (tmp_path / LAST).parent.iterdir()}
    assert names <= {"best.ckpt", "last.ckpt", "previous.ckpt"}


def test_lower_is_better_where_the_metric_is_a_loss(tmp_path, six_steps, scored):
    scored(0.1, 0.4, 0.05, 0.3, 0.1, 0.2)
    fit(six_steps, tmp_path, "optimized_mode=min")
    assert read_checkpoint((tmp_path / LAST).with_name(BEST_NAME))["global_step"] == 3


def test_a_run_that_gets_no_better_ends(tmp_path, six_steps, scored, caplog):
    """Two validations without a better score: step 2 was the best, step 4 the last."""
    scored(0.1, 0.4, 0.2, 0.3, 0.1, 0.2)
    with caplog.at_level(logging.INFO, "raytran"):
        result = fit(six_steps, tmp_path, "early_stopping.patience=2")
    assert result.steps == read_finished(tmp_path).steps == 4
    assert "stage2 may start from it" in caplog.text


@pytest.mark.parametrize(
    ("mode", "threshold", "steps"),
    [("max", "0.35", 4), ("max", "0.5", 6), ("max", "0.4", 6), ("min", "0.15", 1)],
)
def test_a_run_that_is_good_enough_ends(tmp_path, six_steps, scored, mode, threshold, steps):
    """At the first validation whose score is beyond the threshold, not at it."""
    scored(0.1, 0.3, 0.2, 0.4, 0.1, 0.2)
    settings = [f"optimized_mode={mode}", f"early_stopping.threshold={threshold}"]
    assert fit(six_steps, tmp_path, *settings).steps == steps


def test_a_run_that_is_good_enough_or_gets_no_better_ends(tmp_path, six_steps, scored):
    scored(0.1, 0.3, 0.2, 0.2, 0.1, 0.9)
    settings = ["early_stopping.threshold=0.8", "early_stopping.patience=2"]
    assert fit(six_steps, tmp_path, *settings).steps == 4


def test_validations_may_score_the_training_scenes(settings):
    """All of them, in the order of their list, from frames that are always the same."""
    fixed = [*settings, "experiment=stage1", "output_dir=none"]
    of_split = {}
    for split in ("train", "val"):
        data = build_data(compose("train", [*fixed, f"data.val_split={split}"]))
        first, again = list(data.val_dataloader()), list(data.val_dataloader())
        assert [batch.frame_id for batch in first] == [batch.frame_id for batch in again]
        of_split[split] = [batch.scene_id[0] for batch in first]
        assert of_split[split] == list(data.split(split).scene_ids)
    assert not set(of_split["train"]) & set(of_split["val"])


def test_a_run_that_has_not_learned_says_that_the_next_stage_will_refuse(tmp_path, six_steps, scored, caplog):
    scored(*[0.01] * 6)
    with caplog.at_level(logging.INFO, "raytran"):
        fit(six_steps, tmp_path)
    assert "stage2 will refuse to start from it: it has not learned occupancy" in caplog.text
    assert "novel_view may start from it" in caplog.text


@pytest.mark.parametrize("more", [(), ("early_stopping.patience=1",)])
def test_a_score_that_no_validation_has_ends_no_run(tmp_path, six_steps, caplog, more):
    """Lightning's callbacks alone would end it at its first validation."""
    with caplog.at_level(logging.WARNING, "raytran"):
        result = fit(six_steps, tmp_path, "optimized_metric=val/occupancy/iuo", *more)
    assert result.steps == 6
    assert (
        caplog.text.count("validation has no val/occupancy/iuo (optimized_metric): no best.ckpt is kept") == 1
    )
    assert not (tmp_path / LAST).with_name(BEST_NAME).exists()


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("optimized_mode=best", "unknown optimized_mode=best: choose max or min"),
        ("early_stopping.patience=-1", "must be a number of validations or 0 for never, got -1"),
        ("early_stopping.threshold=high", "threshold must be a number or null for none, got high"),
        ("early_stopping.threshold=true", "threshold must be a number or null for none, got True"),
    ],
)
def test_settings_without_a_meaning(tmp_path, setting, said):
    cfg = compose("train", ["preset=tiny", "trainer=cpu", f"output_dir={tmp_path}", setting])
    with pytest.raises(ConfigError, match=said):
        build_trainer(cfg, RunConfig.read(cfg), {"stage": "stage1", "config": plain(cfg)}, StageCallback())
