# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import lightning.pytorch as pl
import pytest
import torch

from raytran.errors import ConfigError
from raytran.structs import ObjectSet
from raytran.training.callbacks.stage import StageCallback


def fit(module, batch, **settings):
    trainer = pl.Trainer(
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[StageCallback()],
        **settings,
    )
    loader = torch.utils.data.DataLoader([batch], batch_size=None)
    trainer.fit(module, loader, loader)
    return trainer


def test_terms_and_scores_are_logged_by_split_and_task(batch, make_module):
    logged = fit(make_module("stage2"), batch, max_steps=1).logged_metrics
    for name in (
        "train/total",
        "train/objects/center",
        "train/objects/class/layer0",
        "val/objects/yaw",
        "val/foreground",
    ):
        assert torch.isfinite(logged[name]), name
    for name in (
        "val/objects/accuracy_global",
        "val/objects/f1_0.5",
        "val/occupancy/iou",
        "val/foreground/iou",
    ):
        assert 0 <= logged[name] <= 1, name


def test_mean_average_precision_is_logged_on_request(batch, make_module):
    logged = fit(make_module("stage2", "map_boxes=oriented"), batch, max_steps=1).logged_metrics
    for name in ("map_0.25", "map_0.5", "map_0.5/chair", "map_0.5/table"):
        assert 0 <= logged[f"val/objects/{name}"] <= 1, name
    plain = fit(make_module("stage2"), batch, max_steps=1).logged_metrics
    assert not any("map" in name for name in plain)
    assert all(torch.equal(logged[name], value) for name, value in plain.items() if name.startswith("val/"))
    with pytest.raises(ConfigError, match="unknown boxes=upright"):
        make_module("stage2", "map_boxes=upright")


def test_new_views_are_scored_beside_answers_that_render_nothing(batch, make_module):
    logged = fit(make_module("novel_view"), batch, max_steps=1).logged_metrics
    torch.testing.assert_close(logged["train/total"], 10 * logged["train/view"])
    for name in ("psnr", "ssim", "psnr_best_constant", "psnr_nearest_frame"):
        assert torch.isfinite(logged[f"val/view/{name}"]), name
    assert "val/occupancy/iou" not in logged


def test_training_renders_views_better(batch, make_module):
    """Two photographs of noise: what can be learned of them is their mean colour."""
    module = make_module("novel_view", "optimizer.learning_rate=0.01")
    first = fit(module, batch, max_steps=1).logged_metrics
    last = fit(module, batch, max_steps=20).logged_metrics
    assert last["val/view"] < first["val/view"]
    assert last["val/view/psnr"] > last["val/view/psnr_nearest_frame"] + 1


def test_training_lowers_the_loss(batch, make_module):
    module = make_module("stage2")
    first = fit(module, batch, max_steps=1).logged_metrics["val/total"]
    last = fit(module, batch, max_steps=25).logged_metrics["val/total"]
    assert last < 0.8 * first


@pytest.mark.parametrize("experiment", ["stage2", "stage3"])
def test_a_scene_without_objects_trains(experiment, batch, make_module):
    empty = replace(ObjectSet.empty(), shape=torch.zeros(0, 63, 63, 63, dtype=torch.bool))
    trainer = fit(make_module(experiment), replace(batch, objects=(empty,)), max_steps=1)
    assert torch.isfinite(trainer.logged_metrics["train/total"])


@pytest.mark.slow
def test_compiled_or_not_the_loss_and_the_names_of_the_weights_are_the_same(batch, make_module, monkeypatch):
    """Without generated code, which needs a compiler: what is tested is what dynamo makes of the function."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    short = "model.backbone.num_blocks=1"
    plain, compiled = make_module("stage1", short), make_module("stage1", short, "compile=true")
    assert plain.state_dict().keys() == compiled.state_dict().keys()
    few = {"max_steps": 1, "limit_val_batches": 0}
    losses = [fit(module, batch, **few).logged_metrics["train/total"] for module in (plain, compiled)]
    torch.testing.assert_close(losses[0], losses[1])
    for name, weight in plain.state_dict().items():
        torch.testing.assert_close(weight, compiled.state_dict()[name], msg=name)


def test_a_validation_scene_that_comes_twice_counts_once(batch, make_module):
    """On two ranks of three scenes the last of the second rank is the first scene again."""
    module = make_module("stage2")
    loader = torch.utils.data.DataLoader([batch] * 3, batch_size=None)
    module.trainer = SimpleNamespace(world_size=2, global_rank=1, val_dataloaders=loader)
    assert [module._is_repeated(index) for index in range(2)] == [False, True]
    module.trainer.global_rank = 0
    assert [module._is_repeated(index) for index in range(2)] == [False, False]


def test_validation_does_not_depend_on_what_comes_twice(batch, make_module, monkeypatch):
    module = make_module("stage2")
    other = replace(batch, occupancy=~batch.occupancy, scene_id=("other",))
    once = validate(module, [batch, other])
    monkeypatch.setattr(type(module), "_is_repeated", lambda _, index: index == 2)
    assert validate(module, [batch, other, batch]) == once
    assert validate(module, [batch, other, other]) == once
    monkeypatch.undo()
    assert validate(module, [batch, other, other]) != once


def test_the_optimiser_is_fused_unless_a_scaler_or_an_apple_gpu_forbids_it(batch, make_module, monkeypatch):
    module = make_module("stage1")
    trainer = fit(module, batch, max_steps=1)
    assert trainer.optimizers[0].defaults["fused"] is True
    with monkeypatch.context() as context:
        context.setattr(trainer.precision_plugin, "scaler", object(), raising=False)
        assert module.configure_optimizers()["optimizer"].defaults["fused"] is False
    monkeypatch.setattr(type(module), "device", torch.device("mps"))
    assert module.configure_optimizers()["optimizer"].defaults["fused"] is False


def validate(module, batches):
    trainer = pl.Trainer(
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    loader = torch.utils.data.DataLoader(batches, batch_size=None)
    return trainer.validate(module, loader, verbose=False)
