# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import logging
from types import SimpleNamespace

import lightning.pytorch as pl
import pytest

from raytran.errors import RaytranError
from raytran.training.callbacks import run_checks
from raytran.training.callbacks.run_checks import EffectiveBatch, RankAgreement

MOMENTS = ("on_train_start", "on_validation_start", "on_train_end")


def said(caplog, *, per_device, expected, nodes=1, devices=1, accumulated=1, first=True):
    trainer = SimpleNamespace(
        is_global_zero=first,
        num_nodes=nodes,
        world_size=nodes * devices,
        accumulate_grad_batches=accumulated,
        precision="32-true",
    )
    with caplog.at_level(logging.INFO, "raytran"):
        EffectiveBatch(per_device=per_device, expected=expected).on_fit_start(trainer, None)
    return [(record.levelname, record.getMessage()) for record in caplog.records]


def test_the_papers_batch_is_told_and_not_warned_of(caplog):
    told = said(caplog, per_device=1, expected=8, nodes=2, devices=2, accumulated=2)
    assert [level for level, _ in told] == ["INFO"]
    assert told[0][1].startswith("8 scenes a step: 2 devices × 2 nodes × views.batch_size=1 × ")
    assert told[0][1].endswith("trainer.accumulate_grad_batches=2, precision 32-true")


@pytest.mark.parametrize(
    ("settings", "advice"),
    [
        ({"per_device": 1, "expected": 8}, "set trainer.accumulate_grad_batches=8, or schedule.batch=1 if"),
        ({"per_device": 2, "expected": 2, "devices": 2}, "set views.batch_size=1 and trainer.accumulate_"),
        (
            {"per_device": 1, "expected": 8, "devices": 3},
            "a number of devices that divides 8, or schedule.batch=3",
        ),
    ],
)
def test_another_batch_is_warned_of_with_the_keys_to_change(caplog, settings, advice):
    (_, (level, warning)) = said(caplog, **settings)
    assert level == "WARNING"
    assert advice in warning


def test_one_rank_speaks(caplog):
    assert said(caplog, per_device=1, expected=8, first=False) == []


@pytest.mark.parametrize("moment", MOMENTS)
def test_ranks_that_differ_stop(moment, make_module, monkeypatch):
    """Weights and buffers are compared; tests/training/test_ranks.py compares real ranks."""
    module = make_module("stage1")
    compared = []

    def differ(tensors, device):
        compared.extend(tensors)
        return False

    monkeypatch.setattr(run_checks, "agree", differ)
    trainer = SimpleNamespace(world_size=2, global_step=7)
    with pytest.raises(RaytranError, match="networks differ at step 7: continue from an earlier checkpoint"):
        getattr(RankAgreement(), moment)(trainer, module)
    assert len(compared) == len([*module.parameters(), *module.buffers()])
    norm = module.model.backbone.encoder.bn1
    assert any(tensor is norm.running_var for tensor in compared)
    assert any(tensor is norm.weight for tensor in compared)


@pytest.mark.parametrize("moment", MOMENTS)
def test_one_rank_has_nothing_to_compare(moment, monkeypatch):
    monkeypatch.setattr(run_checks, "agree", lambda *_: pytest.fail("asked"))
    getattr(RankAgreement(), moment)(SimpleNamespace(world_size=1), pl.LightningModule())
