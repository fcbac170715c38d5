# SPDX-License-Identifier: Apache-2.0
"""All layers and scenes at once equal one after the other, in values and in gradients."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

from raytran.losses.matcher import HungarianMatcher
from raytran.losses.total import WEIGHTS, TotalLoss
from raytran.structs import ObjectSet, RawObjects, RawScene, SceneBatch, Views

from .one_by_one import object_terms

SIZES = (10, 3, 3, 2, 4)
TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-6}


def in_dtype(objects: ObjectSet, dtype: torch.dtype) -> ObjectSet:
    exact = {name: getattr(objects, name).to(dtype) for name in ("center", "size", "rotation")}
    turns = torch.tensor([1, 2, 4, 0])[torch.arange(len(objects)) % 4]
    return replace(objects, **exact, symmetry=turns)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("class_cost", ["probability", "cross_entropy"])
@pytest.mark.parametrize("counts", [(3,), (3, 1), (0, 2), (2, 0, 5), (0,), (0, 0), (9, 4)])
def test_losses_and_gradients(counts, class_cost, dtype, make_objects, monkeypatch) -> None:
    """Ragged scenes, without objects, and with more of them than queries."""
    # In float64 all through, where the losses go to float32 else.
    monkeypatch.setattr(RawObjects, "in_float32", lambda self: self)
    targets = [in_dtype(make_objects(count, seed), dtype) for seed, count in enumerate(counts)]
    generator = torch.Generator().manual_seed(7)
    layers = [
        RawObjects(
            *(
                torch.randn(len(counts), 6, n, generator=generator, dtype=dtype).requires_grad_()
                for n in SIZES
            )
        )
        for _ in range(3)
    ]
    weights = dict(zip(WEIGHTS, range(2, 11), strict=True))
    matcher = HungarianMatcher(weights=weights, class_cost=class_cost)
    loss = TotalLoss(weights=weights, matcher=matcher, center_beta=0.3, yaw_beta=0.2)
    views = Views(torch.zeros(1, 1, 3, 4, 4), torch.eye(3)[None, None], torch.eye(4)[None, None])
    batch = SceneBatch(("a",), views, (("0",),), torch.zeros(1, 3), objects=tuple(targets))
    raw = RawScene(torch.zeros(1, 3), objects=tuple(layers))
    monkeypatch.setattr(torch.Tensor, "float", lambda self: self)
    found = loss(raw, batch, terms=("objects",))
    expected = object_terms(loss, layers, targets)
    assert found.keys() == {*expected, "total"}
    read = [getattr(layer, field.name) for layer in layers for field in fields(layer)[:4]]
    tolerance = {"rtol": TOLERANCE[dtype], "atol": TOLERANCE[dtype]}
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, **tolerance, msg=name)
    total = sum(loss.weights[name.split("/")[1]] * value for name, value in expected.items())
    gradients, others = (
        torch.autograd.grad(of, read, allow_unused=True, materialize_grads=True)
        for of in (found["total"], total)
    )
    for gradient, other in zip(gradients, others, strict=True):
        torch.testing.assert_close(gradient, other, **tolerance)
