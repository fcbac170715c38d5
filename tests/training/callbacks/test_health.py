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


def overflow(module, first, last, call="conv1"):
    """Let activations overflow in the given forward passes, counted from 1."""
    calls = []

    def hook(_module, _arguments, output):
        calls.append(None)
        return output * math.inf if first <= len(calls) <= last else output

    (layer,) = (m for name, m in module.named_modules() if name.endswith(f".encoder.{call}"))
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


def test_an_overflowing_step_leaves_no_trace(fit, make_module, caplog):
    health, states = Health(max_skipped=3), States()
    trainer = fit(health, states, module=overflow(make_module("stage2"), 2, 2), max_steps=3)
    before, skipped, after = states.seen
    assert same(before, skipped)
    assert not same(skipped, after)
    assert all(value.isfinite().all() for value in after[0].values())
    assert trainer.logged_metrics["health/skipped_steps"] == 1
    assert trainer.global_step == 3
    assert "step 1 skipped: the loss (" in caplog.text


def test_a_step_of_several_batches_is_skipped_as_a_whole(fit, make_module):
    health, states = Health(max_skipped=3), States()
    module = overflow(make_module("stage2"), 3, 3)
    fit(health, states, module=module, max_steps=3, accumulate_grad_batches=2)
    assert same(states.seen[1], states.seen[3]), "the third batch is the first of the second step"
    assert health.state_dict() == {"skipped": 1, "in_a_row": 0}


def test_a_gradient_alone_is_seen_too(fit, make_module, caplog):
    module = make_module("stage2")
    parameter = module.model.heads["foreground"].get_parameter(
        next(name for name, _ in module.model.heads["foreground"].named_parameters())
    )
    parameter.register_hook(lambda gradient: gradient * math.nan)
    states = States()
    with pytest.raises(NonFiniteError):
        fit(Health(max_skipped=2), states, module=module, max_steps=5)
    assert "skipped: the gradient of foreground (1 in a row" in caplog.text


def test_a_run_gives_up_with_the_weights_of_its_last_good_step(fit, make_module):
    module = overflow(make_module("stage2"), 2, 99)
    states = States()
    with pytest.raises(
        NonFiniteError, match=r"3 steps in a row were not finite, the last one step 3 \(the loss"
    ):
        fit(states, Health(max_skipped=3), module=module, max_steps=20)
    first, *skipped = states.seen
    assert len(skipped) == 3
    assert all(same(first, state) for state in skipped)


def test_an_infinite_loss_with_finite_gradients_is_skipped(fit, make_module, caplog):
    module = make_module("stage1")
    with torch.no_grad():
        module.model.heads["occupancy"].convolution.bias.fill_(math.inf)
    with pytest.raises(NonFiniteError):
        fit(Health(max_skipped=1), module=module, max_steps=2)
    assert "step 0 skipped: the loss (occupancy)" in caplog.text


def test_the_count_starts_anew_after_a_good_step(fit, make_module):
    module = overflow(overflow(make_module("stage2"), 2, 3), 5, 6)
    health = Health(max_skipped=3)
    fit(health, module=module, max_steps=8)
    assert health.state_dict() == {"skipped": 4, "in_a_row": 0}
    again = Health(max_skipped=3)
    again.load_state_dict(health.state_dict())
    assert again.state_dict() == health.state_dict()


def test_signals_are_logged_where_the_losses_are(fit):
    health = Health(max_skipped=3)
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
def test_half_precision_too(precision, fit, make_module):
    health, states = Health(max_skipped=3), States()
    module = overflow(make_module("stage1"), 2, 2)
    # By name, the Trainer takes 16-mixed for bf16-mixed on a CPU. The scale is one that does not overflow.
    scaler = torch.amp.GradScaler("cpu", init_scale=256.0) if precision == "16-mixed" else None
    half = MixedPrecision(precision, "cpu", scaler)
    trainer = fit(health, states, module=module, max_steps=3, plugins=[half], gradient_clip_val=0.1)
    assert same(states.seen[0], states.seen[1])
    assert math.isfinite(trainer.logged_metrics["train/total"])
    assert trainer.logged_metrics["health/skipped_steps"] >= 1
