# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.training.optim import Optimization, learning_rate_factor


@pytest.mark.parametrize(
    ("step", "decay", "expected"),
    [
        (0, "none", 0.25),
        (3, "none", 1.0),
        (500, "none", 1.0),
        (4, "cosine", 1.0),
        (54, "cosine", 0.5),  # half-way between warm-up (4) and end (104): (1 + cos 90°) / 2
        (104, "cosine", 0.0),
        (200, "cosine", 0.0),
    ],
)
def test_factor(step, decay, expected):
    factor = learning_rate_factor(step, total_steps=104, warmup_steps=4, decay=decay)
    assert factor == pytest.approx(expected, abs=1e-12)


def test_defaults_are_the_papers():
    built = Optimization().build([torch.nn.Parameter(torch.zeros(2))], total_steps=10)
    group = built["optimizer"].param_groups[0]
    assert type(built["optimizer"]) is torch.optim.AdamW
    assert (group["lr"], group["weight_decay"]) == (1e-4, 5e-2)


def test_frozen_parameters_are_left_out():
    frozen, trained = (
        torch.nn.Parameter(torch.zeros(1), requires_grad=False),
        torch.nn.Parameter(torch.zeros(1)),
    )
    built = Optimization().build([frozen, trained], total_steps=10)
    assert [p is trained for p in built["optimizer"].param_groups[0]["params"]] == [True]


def test_state_is_plain_python():
    built = Optimization(decay="cosine").build([torch.nn.Parameter(torch.zeros(1))], total_steps=10)
    state = built["lr_scheduler"]["scheduler"].state_dict()
    plain = (int, float, bool, str, list, type(None))
    values = [value for key, value in state.items() if key != "lr_lambdas"]
    assert all(isinstance(value, plain) for value in values)
    assert state["lr_lambdas"] == [{}] or state["lr_lambdas"] == [None]


@pytest.mark.parametrize("fused", [False, True])
def test_a_state_is_loaded_by_an_optimiser_that_is_fused_or_not_as_it_was_made(fused):
    """A run may go on on a CPU that began on a GPU, and the other way round."""
    optimizers = []
    for was_fused in (not fused, fused):
        weight = torch.nn.Parameter(torch.ones(3))
        optimizers.append(Optimization().build([weight], total_steps=10, fused=was_fused)["optimizer"])
        weight.grad = torch.tensor([1.0, -2.0, 0.5])
    optimizers[0].step()
    optimizers[1].load_state_dict(optimizers[0].state_dict())
    assert optimizers[1].param_groups[0]["fused"] == fused
    for optimizer in optimizers:
        (optimizer.param_groups[0]["params"][0]).data.fill_(1.0)
        optimizer.step()
    first, second = (optimizer.param_groups[0]["params"][0] for optimizer in optimizers)
    torch.testing.assert_close(first, second)


def test_a_fused_optimiser_skips_and_clips_by_itself():
    moved = []
    for found_inf, scale in ((0.0, 1.0), (1.0, 1.0), (0.0, 4.0)):
        weight = torch.nn.Parameter(torch.ones(2))
        optimizer = Optimization().build([weight], total_steps=10, fused=True)["optimizer"]
        weight.grad = torch.tensor([2.0, -4.0])
        optimizer.found_inf, optimizer.grad_scale = torch.tensor(found_inf), torch.tensor(scale)
        optimizer.step()
        moved.append((weight.detach().clone(), optimizer.state[weight]["exp_avg"].clone()))
    (plain, moment), (skipped, unmoved), (_, scaled) = moved
    assert not torch.equal(plain, torch.ones(2))
    assert torch.equal(skipped, torch.ones(2))
    assert not unmoved.any()
    torch.testing.assert_close(4 * scaled, moment)
