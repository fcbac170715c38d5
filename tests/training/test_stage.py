# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import copy
from dataclasses import replace

import lightning.pytorch as pl
import pytest
import torch
from torch.nn.modules.batchnorm import _BatchNorm

from raytran.errors import ConfigError
from raytran.model import inputs_of
from raytran.training.callbacks.stage import StageCallback

# What RayTran §4 trains in each stage, by the beginnings of parameter names.
TRAINED = {
    "stage1": ("backbone.", "heads.occupancy."),
    "stage2": ("backbone.", "heads.occupancy.", "heads.foreground.", "heads.objects."),
    "stage3": ("heads.shape.",),
    "novel_view": ("backbone.", "heads.view."),
}
# Without masks nothing reads the pixels after the last block (of two), so its pixel stream cannot learn.
UNREACHED = dict.fromkeys(
    ("stage1", "novel_view"), ("backbone.blocks.1.pixel_stream.", "backbone.pixel_norm.")
)


def fit(module, batch, steps=2, callbacks=()):
    """Fit for a few steps, with a validation after each."""
    trainer = pl.Trainer(
        accelerator="cpu",
        max_steps=steps,
        limit_val_batches=1,
        val_check_interval=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[StageCallback(), *callbacks],
    )
    loader = torch.utils.data.DataLoader([batch] * steps, batch_size=None)
    trainer.fit(module, loader, loader)
    return trainer


@pytest.mark.parametrize("experiment", list(TRAINED))
def test_a_step_reaches_what_the_stage_trains_and_nothing_else(experiment, batch, make_module):
    module = make_module(experiment)
    module.stage.freeze(module.model)
    raw = module.model(**inputs_of(batch), tasks=module.stage.tasks)
    losses = module.loss(raw, batch, terms=module.stage.terms, decode_shapes=module.model.decode_shapes)
    losses["total"].backward()
    for name, parameter in module.model.named_parameters():
        expected = name.startswith(TRAINED[experiment]) and not name.startswith(
            UNREACHED.get(experiment, ("-",))
        )
        assert parameter.requires_grad == expected, name
        assert (parameter.grad is not None) == expected, name


@pytest.mark.parametrize(
    ("settings", "trained"),
    [
        (["model/backbone=unprojection"], ("backbone.", "heads.view.")),
        (
            ["model.backbone.encoder.stride=8", "model.heads.foreground.widths=[32,16]"],
            ("backbone.", "heads.view."),
        ),
        (["stage.trainable=[heads.view]"], ("heads.view.",)),
        (
            [
                "stage.tasks=[occupancy,view]",
                "stage.terms=[occupancy,view]",
                "stage.trainable=[backbone,heads.occupancy,heads.view]",
            ],
            ("backbone.", "heads.occupancy.", "heads.view."),
        ),
    ],
)
def test_views_are_rendered_from_any_backbone_alone_or_along_with_other_tasks(
    settings, trained, batch, make_module
):
    module = make_module("novel_view", *settings)
    module.stage.freeze(module.model)
    raw = module.model(**inputs_of(batch), tasks=module.stage.tasks)
    assert raw.new_views.shape == batch.new_views.images.shape
    module.loss(raw, batch, terms=module.stage.terms)["total"].backward()
    learning = {name for name, parameter in module.model.named_parameters() if parameter.grad is not None}
    assert learning == {name for name, p in module.model.named_parameters() if p.requires_grad}
    assert {name for name in learning if not name.startswith(trained)} == set()
    assert all(any(name.startswith(part) for name in learning) for part in trained)


@pytest.mark.parametrize("experiment", list(TRAINED))
def test_a_fit_moves_what_the_stage_trains_and_nothing_else(experiment, batch, make_module):
    module = make_module(experiment)
    before = copy.deepcopy(module.model.state_dict())
    fit(module, batch)
    after = module.model.state_dict()
    moved = {name for name in before if not torch.equal(before[name], after[name])}
    assert moved
    assert all(name.startswith(TRAINED[experiment]) for name in moved)
    statistics = {name for name in moved if "running_" in name or "num_batches" in name}
    # Batch-norm statistics follow the images while the backbone trains, and stand still in stage 3.
    assert bool(statistics) == (experiment != "stage3")


def test_frozen_parts_stay_in_evaluation_mode(batch, make_module):
    module = make_module("stage3")
    modes = []

    class Watch(pl.Callback):
        def on_before_zero_grad(self, trainer, pl_module, *_):
            modes.append({name: part.training for name, part in pl_module.model.named_modules()})

    trainer = pl.Trainer(
        accelerator="cpu",
        max_steps=3,
        val_check_interval=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[StageCallback(), Watch()],
    )
    loader = torch.utils.data.DataLoader([batch], batch_size=None)
    trainer.fit(module, loader, loader)
    assert len(modes) == 3
    for mode in modes:
        assert mode["heads.shape"]
        assert mode["heads.shape.upsampler.0"]
        assert not any(
            training for name, training in mode.items() if name.startswith(("backbone", "heads.objects"))
        )


@pytest.mark.parametrize("preset", ["tiny", "laptop"])
def test_frozen_norms_learn_with_what_they_predict_with_and_keep_it(preset, batch, make_module):
    module = make_module("frozen_norms_stage2", f"preset={preset}", "model.grid_resolution=[8,8,4]")
    for name, buffer in module.model.named_buffers():
        if name.endswith("running_var"):
            buffer.fill_(0.7)
    before = copy.deepcopy(module.model.state_dict())
    fit(module, batch, steps=3)
    after = module.model.state_dict()
    norms = [name for name, part in module.model.named_modules() if isinstance(part, _BatchNorm)]
    assert norms
    for norm in norms:
        for name in ("running_mean", "running_var", "num_batches_tracked"):
            assert torch.equal(before[f"{norm}.{name}"], after[f"{norm}.{name}"]), norm
    learning = {name for name, parameter in module.model.named_parameters() if parameter.requires_grad}
    scales = {f"{norm}.weight" for norm in norms} & learning
    assert scales
    assert all(not torch.equal(before[name], after[name]) for name in scales), "scale and shift still learn"


@pytest.mark.parametrize("experiment", ["stage2", "frozen_norms_stage2"])
def test_statistics_move_or_stay_whatever_mode_somebody_sets(experiment, batch, make_module):
    class Meddling(pl.Callback):
        def on_train_batch_end(self, trainer, pl_module, *_):
            pl_module.train(mode=experiment != "stage2")

    module = make_module(experiment)
    fit(module, batch, steps=3, callbacks=[Meddling()])
    counts = {int(v) for name, v in module.model.named_buffers() if name.endswith("num_batches_tracked")}
    assert counts == ({3} if experiment == "stage2" else {0})


def test_an_unknown_part_is_an_error(make_module):
    module = make_module("stage1")
    stage = replace(module.stage, trainable=["backbone", "heads.colour"])
    with pytest.raises(ConfigError, match=r"stage1 trains 'heads\.colour'"):
        stage.freeze(module.model)
