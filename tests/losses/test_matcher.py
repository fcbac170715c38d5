# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from raytran.classes import PAPER_CLASSES
from raytran.errors import ConfigError
from raytran.losses.matcher import HungarianMatcher
from raytran.losses.objects import Differences, Match, TrueObjects
from raytran.structs import ObjectSet, RawObjects

WEIGHTS = {"class": 1.0, "center": 2.0, "size": 1.0, "yaw": 1.0}


def match_one(matcher: HungarianMatcher, raw: RawObjects, objects: ObjectSet) -> Match:
    """Return the pairs of one layer and scene, ``(P,)``."""
    match = matcher(RawObjects.stack([raw]), TrueObjects.of(objects), [len(objects)])
    return Match(match.query[0], match.target[0])


def cost_of(matcher: HungarianMatcher, raw: RawObjects, objects: ObjectSet) -> torch.Tensor:
    """Return the cost ``(Q, M)`` in one scene."""
    true = TrueObjects.of(objects)
    return matcher.cost(raw, true, Differences.of_all(raw, true))[0]


@pytest.mark.parametrize("blind", [(), ("class",), ("center",), ("size", "yaw")])
def test_finds_a_planted_permutation(make_objects, make_perfect, blind) -> None:
    """Also when some of the terms weigh nothing: each of the others tells the objects apart."""
    objects, queries = make_objects(5), torch.tensor([7, 2, 9, 0, 4])
    matcher = HungarianMatcher(weights={**WEIGHTS, **dict.fromkeys(blind, 0.0)})
    match = match_one(matcher, make_perfect(objects, queries, 10), objects)
    assert dict(zip(match.query.tolist(), match.target.tolist(), strict=True)) == {
        7: 0,
        2: 1,
        9: 2,
        0: 3,
        4: 4,
    }


def test_a_likely_class_costs_less(make_objects) -> None:
    """Minus the probability of the object's class, so that what suits best costs least."""
    objects = replace(make_objects(2), label=torch.tensor([3, 6]))
    logits = torch.randn(1, 4, len(PAPER_CLASSES) + 1, generator=torch.Generator().manual_seed(1))
    logits[0, 2, 3] = 8.0
    rest = [torch.zeros(1, 4, size) for size in (3, 3, 2, 4)]
    matcher = HungarianMatcher(weights={"class": 1.0, "center": 0.0, "size": 0.0, "yaw": 0.0})
    cost = cost_of(matcher, RawObjects(logits, *rest), objects)
    torch.testing.assert_close(cost, -logits[0].exp()[:, [3, 6]] / logits[0].exp().sum(dim=-1, keepdim=True))
    assert int(cost[:, 0].argmin()) == 2


def test_the_class_may_cost_its_cross_entropy(make_objects) -> None:
    """A query that is sure of a wrong class then loses its object to one that is nowhere near."""
    objects = replace(make_objects(1), label=torch.tensor([3]))
    logits = torch.zeros(1, 2, len(PAPER_CLASSES) + 1)
    logits[0, 0, 6] = 12.0  # query 0 stands where the object does, query 1 a metre away
    center = objects.center + torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    raw = RawObjects(
        logits, center[None], objects.size.log().expand(1, 2, 3), torch.zeros(1, 2, 2), torch.zeros(1, 2, 4)
    )
    chosen = {}
    for class_cost in ("probability", "cross_entropy"):
        matcher = HungarianMatcher(weights=WEIGHTS, class_cost=class_cost)
        chosen[class_cost] = int(match_one(matcher, raw, objects).query)
    assert chosen == {"probability": 0, "cross_entropy": 1}
    only_class = HungarianMatcher(weights=WEIGHTS | {"center": 0, "yaw": 0}, class_cost="cross_entropy")
    expected = torch.nn.functional.cross_entropy(logits[0], torch.tensor([3, 3]), reduction="none")
    torch.testing.assert_close(cost_of(only_class, raw, objects)[:, 0], expected)
    with pytest.raises(ConfigError, match="unknown class_cost=focal: choose one of probability, cross_ent"):
        HungarianMatcher(weights=WEIGHTS, class_cost="focal")


def test_betas_count_in_the_cost(make_objects, make_perfect) -> None:
    objects = make_objects(1)
    raw = make_perfect(objects, torch.tensor([0]), 1)
    moved = replace(raw, center=raw.center + torch.tensor([0.4, 0.0, 0.0]))
    cost = {
        beta: float(cost_of(HungarianMatcher(weights=WEIGHTS, center_beta=beta), moved, objects).detach())
        for beta in (0.0, 0.1, 0.8)
    }
    # Minus the class's probability, 1, plus twice the smooth L1 of 0.4 m.
    assert cost == {
        beta: pytest.approx(2 * value - 1, abs=1e-4) for beta, value in ((0.0, 0.4), (0.1, 0.35), (0.8, 0.1))
    }


def test_symmetric_turns_cost_nothing(make_objects, make_perfect) -> None:
    objects = replace(make_objects(1), symmetry=torch.tensor([2]))
    raw = make_perfect(objects, torch.tensor([0]), 2)
    turned = replace(raw, yaw_vector=-raw.yaw_vector)
    matcher = HungarianMatcher(weights=WEIGHTS)
    torch.testing.assert_close(cost_of(matcher, raw, objects), cost_of(matcher, turned, objects))


def test_more_objects_than_slots_and_none(make_objects, make_perfect) -> None:
    objects = make_objects(6)
    raw = make_perfect(objects.select(torch.arange(3)), torch.arange(3), 3)
    matcher = HungarianMatcher(weights=WEIGHTS)
    match = match_one(matcher, raw, objects)
    assert sorted(match.target.tolist()) == [0, 1, 2]
    match = match_one(matcher, raw, ObjectSet.empty())
    assert len(match.query) == len(match.target) == 0


def test_survives_numbers_that_are_not_finite(make_objects, make_perfect) -> None:
    objects = make_objects(2)
    raw = make_perfect(objects, torch.arange(2), 3)
    broken = replace(raw, center=torch.full_like(raw.center, torch.nan))
    match = match_one(HungarianMatcher(weights=WEIGHTS), broken, objects)
    assert len(match.query) == 2
