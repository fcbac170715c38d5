# SPDX-License-Identifier: Apache-2.0
"""What is not finite leaves no trace; what is tells how training goes."""

from __future__ import annotations

import math

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision

from raytran.errors import NonFiniteError
from raytran.training.callbacks.health import Health
from raytran.training.replay_file import read_replay

CARD = {"format": "raytran.checkpoint/1", "stage": "stage2", "preset": "tiny", "model": {}, "views": {}}


def overflow(module, first, last, call="conv1"):
    """Let activations overflow in the given forward passes, counted from 1."""
    calls = []

    def hook(_module, _arguments, output):
        calls.append(None)
        return output * math.inf if first <= len(calls) <= last else output

    (layer,) = (m for name, m in module.named_modules() if name == f"model.backbone.resnet.{call}")
    layer.register_forward_hook(hook)
    return module


class States(pl.Callback):
    """Remembers weights, running statistics and the optimiser's moments after every batch."""

    def __init__(self):
        self.seen = []

    def on_train_batch_end(self, trainer, module, *_):
        moments = [
            value.clone() for state in trainer.optimizers[0].state.values() for value in state.values()
        ]
        self.seen.append(
            ({name: value.clone() for name, value in module.model.state_dict().items()}, moments)
        )


def same(a, b):
    return all(torch.equal(a[0][name], b[0][name]) for name in a[0]) and all(
        torch.equal(*pair) for pair in zip(a[1], b[1], strict=True)
    )


def test_an_overflowing_step_leaves_no_trace(fit, make_module, tmp_path, caplog):
    health, states = Health(tmp_path / "replay.pt", max_skipped=3, card=CARD), States()
    trainer = fit(health, states, module=overflow(make_module("stage2"), 2, 2), max_steps=3)
    before, skipped, after = states.seen
    assert same(before, skipped)
    assert not same(skipped, after)
    assert all(value.isfinite().all() for value in after[0].values())
    assert trainer.logged_metrics["health/skipped_steps"] == 1
    assert trainer.global_step == 3
    assert "step 1 skipped: the loss (" in caplog.text
    assert not (tmp_path / "replay.pt").exists()


def test_a_step_of_several_batches_is_skipped_as_a_whole(fit, make_module, tmp_path):
    health, states = Health(tmp_path / "replay.pt", max_skipped=3, card=CARD), States()
    module = overflow(make_module("stage2"), 3, 3)
    fit(health, states, module=module, max_steps=3, accumulate_grad_batches=2)
    assert same(states.seen[1], states.seen[3]), "the third batch is the first of the second step"
    assert health.state_dict() == {"skipped": 1, "in_a_row": 0}


def test_a_gradient_alone_is_seen_too(fit, make_module, tmp_path, caplog):
    module = make_module("stage2")
    parameter = module.model.heads["foreground"].get_parameter(
        next(name for name, _ in module.model.heads["foreground"].named_parameters())
    )
    parameter.register_hook(lambda gradient: gradient * math.nan)
    states = States()
    with pytest.raises(NonFiniteError):
        fit(Health(tmp_path / "replay.pt", max_skipped=2, card=CARD), states, module=module, max_steps=5)
    assert "skipped: the gradient of foreground (1 in a row" in caplog.text


def test_a_run_gives_up_and_keeps_its_last_batches(fit, make_module, batch, tmp_path):
    path = tmp_path / "replay.pt"
    module = overflow(make_module("stage2"), 2, 99)
    start = {}

    class Start(pl.Callback):
        def on_train_batch_end(self, trainer, module, *_):
            start.update({name: value.clone() for name, value in module.model.state_dict().items()})

    with pytest.raises(
        NonFiniteError, match=r"3 steps in a row were not finite.*raytran\.replay .*replay\.pt"
    ):
        fit(Health(path, max_skipped=3, card=CARD), Start(), module=module, max_steps=20)
    content, batches = read_replay(path)
    assert content["global_step"] == 3
    assert (content["stage"], content["replay"]["precision"]) == ("stage2", "32-true")
    assert content["replay"]["scale"] is None
    assert torch.equal(batches[0].views.images, batch.views.images)
    assert torch.equal(batches[0].objects[0].shape, batch.objects[0].shape)
    assert batches[0].frame_id == batch.frame_id
    assert all(torch.equal(content["state_dict"][f"model.{name}"], value) for name, value in start.items())
    assert list(tmp_path.iterdir()) == [path]


def test_the_count_starts_anew_after_a_good_step(fit, make_module, tmp_path):
    module = overflow(overflow(make_module("stage2"), 2, 3), 5, 6)
    health = Health(tmp_path / "replay.pt", max_skipped=3, card=CARD)
    fit(health, module=module, max_steps=8)
    assert health.state_dict() == {"skipped": 4, "in_a_row": 0}
    again = Health(tmp_path / "replay.pt", max_skipped=3, card=CARD)
    again.load_state_dict(health.state_dict())
    assert again.state_dict() == health.state_dict()


def test_signals_are_logged_where_the_losses_are(fit, tmp_path):
    health = Health(tmp_path / "replay.pt", max_skipped=3, card=CARD)
    logged = fit(health, max_steps=2).logged_metrics
    norms = {
        name.split("/")[-1]: float(v) for name, v in logged.items() if name.startswith("health/gradient/")
    }
    assert set(norms) == {"backbone", "occupancy", "foreground", "objects", "all"}
    parts = [value for name, value in norms.items() if name != "all"]
    assert norms["all"] == pytest.approx(math.hypot(*parts), rel=1e-5)
    assert all(value > 0 for value in parts)
    for name in ("class_accuracy", "class_entropy", "slots_used"):
        assert 0 <= logged[f"health/{name}"] <= 1
    quiet = fit(health, experiment="stage1", max_steps=2, log_every_n_steps=2).logged_metrics
    assert set(quiet) == {
        *("train/occupancy", "train/total", "health/skipped_steps"),
        *("health/gradient/all", "health/gradient/backbone", "health/gradient/occupancy"),
    }


@pytest.mark.parametrize("precision", ["bf16-mixed", "16-mixed"])
def test_half_precision_too(precision, fit, make_module, tmp_path):
    health, states = Health(tmp_path / "replay.pt", max_skipped=3, card=CARD), States()
    module = overflow(make_module("stage1"), 2, 2)
    # By name, the Trainer takes 16-mixed for bf16-mixed on a CPU. The scale is one that does not overflow.
    scaler = torch.amp.GradScaler("cpu", init_scale=256.0) if precision == "16-mixed" else None
    half = MixedPrecision(precision, "cpu", scaler)
    trainer = fit(health, states, module=module, max_steps=3, plugins=[half], gradient_clip_val=0.1)
    assert same(states.seen[0], states.seen[1])
    assert math.isfinite(trainer.logged_metrics["train/total"])
    assert trainer.logged_metrics["health/skipped_steps"] >= 1


def test_a_replay_knows_the_scale_of_the_loss(fit, make_module, tmp_path):
    scales = []

    class Scale(pl.Callback):
        def on_before_backward(self, trainer, module, loss):
            scales.append(trainer.precision_plugin.scaler.get_scale())

    module = overflow(make_module("stage1"), 1, 99)
    health = Health(tmp_path / "replay.pt", max_skipped=2, card=CARD)
    with pytest.raises(NonFiniteError):
        fit(Scale(), health, module=module, max_steps=3, plugins=[MixedPrecision("16-mixed", "cpu")])
    content, _ = read_replay(tmp_path / "replay.pt")
    assert content["replay"]["scale"] == scales[-1] > 1
