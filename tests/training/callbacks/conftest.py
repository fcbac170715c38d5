# SPDX-License-Identifier: Apache-2.0
"""A fit of a few steps on one scene, with callbacks and loggers of one's own."""

from __future__ import annotations

from dataclasses import replace

import lightning.pytorch as pl
import pytest
import torch

from raytran.training.callbacks.stage import StageCallback


@pytest.fixture
def fit(batch, make_module):
    """Return a function that trains an experiment's module and returns the trainer."""

    def run(*callbacks, experiment="stage2", module=None, loggers=False, validate=0, **settings):
        trainer = pl.Trainer(
            accelerator="cpu",
            logger=loggers,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            callbacks=[StageCallback(), *callbacks],
            **{"log_every_n_steps": 1, "max_epochs": -1, **settings},
        )
        loader = torch.utils.data.DataLoader([batch] * 40, batch_size=None)
        scenes = [replace(batch, scene_id=(f"scene{n}",)) for n in range(validate)]
        held_out = torch.utils.data.DataLoader(scenes, batch_size=None) if validate else None
        trainer.fit(make_module(experiment) if module is None else module, loader, held_out)
        return trainer

    return run
