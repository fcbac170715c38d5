# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from raytran.errors import ConfigError
from raytran.run.entry import compose
from raytran.run.train.build import build_trainer, plain
from raytran.run.train.settings import RunConfig, does_compile
from raytran.training.callbacks.stage import StageCallback
from raytran.training.ranks import SyncedBatchNorm


def trainer(tmp_path, *settings):
    settings = ("preset=tiny", f"output_dir={tmp_path}", "trainer=cpu", "progress_bar=none", *settings)
    cfg = compose("train", settings)
    return build_trainer(cfg, RunConfig.read(cfg), {"stage": "stage1", "config": plain(cfg)}, StageCallback())


def test_validations_are_counted_in_steps_however_many_batches_a_step_takes(tmp_path):
    """Lightning counts batches, and would validate eight times as often."""
    assert trainer(tmp_path).val_check_interval == 150
    built = trainer(tmp_path, "trainer.accumulate_grad_batches=8")
    assert (built.accumulate_grad_batches, built.val_check_interval) == (8, 1200)


def test_precision_is_one_key(tmp_path):
    assert trainer(tmp_path).precision == "32-true"
    assert trainer(tmp_path, "precision=bf16-mixed").precision == "bf16-mixed"
    with pytest.raises(ConfigError, match="unknown precision=16-mixed here: choose one of auto, bf16-mixed"):
        trainer(tmp_path, "precision=16-mixed")


def test_ranks_share_their_batch_norm_and_look_for_no_unused_parameters(tmp_path):
    strategy = trainer(tmp_path, "trainer=ddp_cpu").strategy
    assert isinstance(strategy._layer_sync, SyncedBatchNorm)
    assert not strategy._ddp_kwargs.get("find_unused_parameters", False)
    assert trainer(tmp_path, "trainer=ddp_cpu", "sync_norms=false").strategy._layer_sync is None


def test_the_graph_of_a_step_is_static_if_the_step_is_one_pass(tmp_path):
    """A static graph is learned in the first pass, which exchanges nothing if another follows."""
    for passes, is_static in ((1, True), (2, False)):
        built = trainer(tmp_path, "trainer=ddp_cpu", f"trainer.accumulate_grad_batches={passes}")
        assert built.strategy._ddp_kwargs["static_graph"] is is_static


def test_compile_is_off_until_it_is_asked_for():
    assert [does_compile(choice) for choice in ("auto", True, False)] == [False, True, False]
    assert compose("train", []).compile == "auto"
    for wrong in ("yes", 1, None):
        with pytest.raises(ConfigError, match=f"unknown compile={wrong}: choose auto, true or false"):
            does_compile(wrong)
