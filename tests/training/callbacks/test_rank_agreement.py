# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from types import SimpleNamespace

import lightning.pytorch as pl
import pytest

from raytran.errors import RaytranError
from raytran.training.callbacks import rank_agreement
from raytran.training.callbacks.rank_agreement import RankAgreement

MOMENTS = ("on_train_start", "on_validation_start", "on_train_end")


@pytest.mark.parametrize("moment", MOMENTS)
def test_ranks_that_differ_stop(moment, make_module, monkeypatch):
    """Weights and buffers are compared; tests/training/test_ranks.py compares real ranks."""
    module = make_module("stage1")
    compared = []

    def differ(tensors, device):
        compared.extend(tensors)
        return False

    monkeypatch.setattr(rank_agreement, "agree", differ)
    trainer = SimpleNamespace(world_size=2, global_step=7)
    with pytest.raises(RaytranError, match="networks differ at step 7: continue from an earlier checkpoint"):
        getattr(RankAgreement(), moment)(trainer, module)
    assert len(compared) == len([*module.parameters(), *module.buffers()])
    norm = module.model.backbone.encoder.bn1
    assert any(tensor is norm.running_var for tensor in compared)
    assert any(tensor is norm.weight for tensor in compared)


@pytest.mark.parametrize("moment", MOMENTS)
def test_one_rank_has_nothing_to_compare(moment, monkeypatch):
    monkeypatch.setattr(rank_agreement, "agree", lambda *_: pytest.fail("asked"))
    getattr(RankAgreement(), moment)(SimpleNamespace(world_size=1), pl.LightningModule())
