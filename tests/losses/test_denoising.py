# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import fields

import pytest
import torch

from raytran.losses.denoising import denoising_losses
from raytran.losses.pose import Betas
from raytran.structs import ObjectSet, RawObjects


def repeated(objects: ObjectSet, make_perfect, count: int) -> RawObjects:
    """Perfect predictions for ``count`` copies of the objects, one after the other."""
    index = torch.arange(count) % len(objects)
    return make_perfect(objects.select(index), torch.arange(count), count)


def scenes(*parts: RawObjects) -> RawObjects:
    return RawObjects(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(parts[0])))


def test_copies_that_became_their_objects_cost_nothing(make_objects, make_perfect) -> None:
    objects = make_objects(3)
    perfect = repeated(objects, make_perfect, 7)
    losses = denoising_losses([perfect, perfect], [objects], betas=Betas())
    assert set(losses) == {"class", "center", "size", "yaw"}
    assert all(float(value.detach()) == pytest.approx(0.0, abs=1e-5) for value in losses.values())


def test_terms_are_means_over_slots_and_sums_over_layers(make_objects, make_perfect) -> None:
    """All copies are 1 m off along one axis: smooth L1 0.95 in each of two layers."""
    objects = make_objects(2)
    off = repeated(objects, make_perfect, 6)
    off.center.data[..., 0] += 1.0
    losses = denoising_losses([off, off], [objects], betas=Betas())
    assert float(losses["center"].detach()) == pytest.approx(2 * 0.95)
    assert float(losses["size"].detach()) == pytest.approx(0.0, abs=1e-6)


def test_the_class_is_a_cross_entropy_over_slots(make_objects, make_perfect) -> None:
    objects = make_objects(2)
    raw = repeated(objects, make_perfect, 4)
    raw.class_logits.data.zero_()
    losses = denoising_losses([raw], [objects], betas=Betas())
    assert float(losses["class"].detach()) == pytest.approx(torch.tensor(10.0).log().item())


def test_scenes_without_objects_cost_nothing_but_count(make_objects, make_perfect) -> None:
    objects, none = make_objects(2), make_objects(0)
    off = repeated(objects, make_perfect, 4)
    off.center.data[..., 0] += 1.0
    raw = scenes(off, off)
    losses = denoising_losses([raw], [objects, none], betas=Betas())
    assert float(losses["center"].detach()) == pytest.approx(0.95 / 2)
    sum(losses.values()).backward()
    assert float(off.center.grad.abs().sum()) == pytest.approx(1 / 2, rel=1e-4)  # 4 slots, an eighth each


def test_even_nothing_has_a_gradient_for_every_rank(make_objects, make_perfect) -> None:
    raw = repeated(make_objects(1), make_perfect, 3)
    losses = denoising_losses([raw], [make_objects(0)], betas=Betas())
    total = sum(losses.values())
    assert float(total.detach()) == 0.0
    total.backward()
    for leaf in (raw.class_logits, raw.center, raw.log_size, raw.yaw_vector):
        assert not leaf.grad.any()
