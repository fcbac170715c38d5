# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from raytran.losses.matcher import HungarianMatcher
from raytran.types import ObjectSet

WEIGHTS = {"class": 1.0, "center": 2.0, "size": 1.0, "yaw": 1.0}


@pytest.mark.parametrize("blind", [(), ("class",), ("center",), ("size", "yaw")])
def test_finds_a_planted_permutation(make_objects, make_perfect, blind) -> None:
    """Also when some of the terms weigh nothing: each of the others tells the objects apart."""
    objects, slots = make_objects(5), torch.tensor([7, 2, 9, 0, 4])
    matcher = HungarianMatcher(weights={**WEIGHTS, **dict.fromkeys(blind, 0.0)})
    (match,) = matcher(make_perfect(objects, slots, 10), [objects])
    assert dict(zip(match.slot.tolist(), match.target.tolist(), strict=True)) == {
        7: 0,
        2: 1,
        9: 2,
        0: 3,
        4: 4,
    }


def test_symmetric_turns_cost_nothing(make_objects, make_perfect) -> None:
    objects = replace(make_objects(1), symmetry=torch.tensor([2]))
    raw = make_perfect(objects, torch.tensor([0]), 2)
    turned = replace(raw, yaw_vector=-raw.yaw_vector)
    matcher = HungarianMatcher(weights=WEIGHTS)
    torch.testing.assert_close(matcher.cost(raw, 0, objects), matcher.cost(turned, 0, objects))


def test_more_objects_than_slots_and_none(make_objects, make_perfect) -> None:
    objects = make_objects(6)
    raw = make_perfect(objects.select(torch.arange(3)), torch.arange(3), 3)
    matcher = HungarianMatcher(weights=WEIGHTS)
    (match,) = matcher(raw, [objects])
    assert sorted(match.target.tolist()) == [0, 1, 2]
    (match,) = matcher(raw, [ObjectSet.empty()])
    assert len(match.slot) == len(match.target) == 0


def test_survives_numbers_that_are_not_finite(make_objects, make_perfect) -> None:
    objects = make_objects(2)
    raw = make_perfect(objects, torch.arange(2), 3)
    broken = replace(raw, center=torch.full_like(raw.center, torch.nan))
    (match,) = HungarianMatcher(weights=WEIGHTS)(broken, [objects])
    assert len(match.slot) == 2
