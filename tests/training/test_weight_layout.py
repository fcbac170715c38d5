# SPDX-License-Identifier: Apache-2.0
"""Weights that lie channels last are the same weights, and so are an optimiser's moments beside them."""

from __future__ import annotations

import copy

import torch
from torch import nn

from raytran.training.optim import Optimization
from raytran.training.weight_layout import lay_channels_last


def network():
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(3, 8, 3, padding=1),
        nn.ConvTranspose2d(8, 4, 4, stride=2, padding=1),
        nn.Unflatten(1, (4, 1)),
        nn.Conv3d(4, 2, 3, padding=1),
    )


def trained(model, optimizer):
    optimizer.zero_grad()
    model(torch.rand(2, 3, 6, 6, generator=torch.Generator().manual_seed(1))).square().mean().backward()
    optimizer.step()
    return model


def optimizer_of(model):
    return Optimization().build(model.parameters(), 10)["optimizer"]


def test_convolutions_lie_channels_last_with_the_same_values():
    model, before = network(), network()
    weights = list(model.parameters())
    lay_channels_last(model)
    assert all(a is b for a, b in zip(model.parameters(), weights, strict=True))
    for weight, other in zip(model.parameters(), before.parameters(), strict=True):
        assert torch.equal(weight, other)
    assert [model[i].weight.stride()[1] for i in (0, 1, 3)] == [1, 1, 1]


def test_moments_of_a_checkpoint_are_laid_out_as_the_weights():
    usual, mine = network(), network()
    lay_channels_last(mine)
    saved = optimizer_of(usual)
    trained(usual, saved)
    mine.load_state_dict(usual.state_dict())
    optimizer = optimizer_of(mine)
    optimizer.load_state_dict(copy.deepcopy(saved.state_dict()))
    for weight, other in zip(mine.parameters(), usual.parameters(), strict=True):
        for name, value in optimizer.state[weight].items():
            assert torch.equal(value, saved.state[other][name])
            assert value.stride() == weight.stride() or name == "step"
    trained(usual, saved)
    trained(mine, optimizer)
    for weight, other in zip(mine.parameters(), usual.parameters(), strict=True):
        torch.testing.assert_close(weight, other)
