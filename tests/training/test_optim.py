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
