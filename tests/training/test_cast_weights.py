# SPDX-License-Identifier: Apache-2.0
"""Weights that are cast together compute what autocast computes with those that it casts one by one."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from raytran.heads.decoder import in_product_dtype
from raytran.norms import LayerNorm
from raytran.training.cast_weights import weights_cast_together

from ..factories import make_model, make_views

TASKS = ("occupancy", "foreground", "objects")


def step(model, *, together):
    model.zero_grad()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        if together:
            with weights_cast_together(model, "cpu"):
                raw = model(make_views(), tasks=TASKS)
        else:
            raw = model(make_views(), tasks=TASKS)
    found = (raw.occupancy, raw.foreground, raw.objects[-1].center, raw.objects[-1].class_logits)
    sum(value.float().square().mean() for value in found).backward()
    return found, {name: p.grad for name, p in model.named_parameters() if p.grad is not None}


def test_equals_autocast_and_leaves_the_weights_as_they_were():
    model = make_model().eval()  # running statistics stay what they are
    before = dict(model.named_parameters())
    expected, gradients = step(model, together=False)
    found, others = step(model, together=True)
    assert all(p is before[name] and p.dtype == torch.float32 for name, p in model.named_parameters())
    for mine, theirs in zip(found, expected, strict=True):
        assert torch.equal(mine, theirs)
    assert others.keys() == gradients.keys()
    assert {gradient.dtype for gradient in others.values()} == {torch.float32}
    off = sum(float((others[name] - g).square().sum()) for name, g in gradients.items()) ** 0.5
    assert off <= 0.02 * sum(float(g.square().sum()) for g in gradients.values()) ** 0.5


def test_frozen_weights_get_no_gradient_and_cost_none():
    model = make_model().eval()
    model.backbone.requires_grad_(False)
    with torch.autocast("cpu", dtype=torch.bfloat16), weights_cast_together(model, "cpu"):
        cast = [p for _, m in model.backbone.named_modules() for p in m._parameters.values() if p is not None]
        assert not any(weight.requires_grad for weight in cast)
        assert {weight.dtype for weight in cast} == {torch.float32, torch.bfloat16}
        assert model.heads["occupancy"].convolution.weight.requires_grad


def test_weights_come_back_after_an_error():
    model = make_model()
    weight = model.heads["occupancy"].convolution.weight
    with pytest.raises(ZeroDivisionError), torch.autocast("cpu"), weights_cast_together(model, "cpu"):
        raise ZeroDivisionError
    assert model.heads["occupancy"].convolution.weight is weight


def test_parts_of_others_stay_with_autocast():
    """They may compute in float32 where they turn autocast off, as windowed attention does."""

    class Others(nn.Module):
        def __init__(self):
            super().__init__()
            self.linear = nn.Linear(2, 2)

    model = nn.ModuleDict({"ours": nn.Linear(2, 2), "theirs": Others()})
    with torch.autocast("cpu"), weights_cast_together(model, "cpu"):
        assert model["ours"].weight.dtype == torch.bfloat16
        assert model["theirs"].linear.weight.dtype == torch.float32
    assert model["ours"].weight.dtype == torch.float32


def test_norms_follow_their_input_under_autocast():
    norm, x = LayerNorm(8), torch.randn(3, 8)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert norm(x).dtype == torch.float32
        half = norm(x.bfloat16())
        assert half.dtype == in_product_dtype(x).dtype == torch.bfloat16
    assert in_product_dtype(x) is x
    torch.testing.assert_close(half.float(), norm(x), atol=3e-2, rtol=3e-2)
