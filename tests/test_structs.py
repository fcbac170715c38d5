# SPDX-License-Identifier: Apache-2.0
"""Sets of objects: what their labels stand for goes with them."""

from __future__ import annotations

import pickle
from dataclasses import replace

import pytest
import torch

from raytran.classes import PAPER_CLASSES, Classes
from raytran.errors import DataError
from raytran.structs import ObjectSet, ScenePrediction

CLASSES = Classes(("drill", "lathe", "bench"))


def some(*labels: int, classes: Classes = CLASSES) -> ObjectSet:
    count = len(labels)
    return ObjectSet(
        label=torch.tensor(labels),
        center=torch.rand(count, 3),
        size=torch.rand(count, 3),
        rotation=torch.eye(3).repeat(count, 1, 1),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.rand(count),
        classes=classes,
    )


def test_classes_go_with_the_objects() -> None:
    objects = some(2, 0)
    assert objects.category == ("bench", "drill")
    others = [
        objects.to("cpu"),
        objects.detach(),
        pickle.loads(pickle.dumps(objects)),
        replace(objects, score=objects.score / 2),
        ObjectSet.join([objects, ObjectSet.empty(CLASSES)]),
    ]
    assert all(other.classes == CLASSES and other.category == objects.category for other in others)
    assert objects.select(torch.tensor([1])).category == ("drill",)
    assert ObjectSet.empty(CLASSES).classes is CLASSES
    assert ObjectSet.empty().classes is PAPER_CLASSES


def test_joined_sets_stand_one_after_another() -> None:
    first, second = some(2, 0), replace(some(1), model_id=("a/b",))
    joined = ObjectSet.join([first, ObjectSet.empty(CLASSES), second])
    assert joined.label.tolist() == [2, 0, 1]
    assert torch.equal(joined.center, torch.cat([first.center, second.center]))
    assert joined.model_id == ()
    assert joined.shape is None
    named = replace(first, model_id=("c/d", "e/f"))
    assert ObjectSet.join([named, second]).model_id == ("c/d", "e/f", "a/b")
    assert len(ObjectSet.join([ObjectSet.empty(CLASSES)])) == 0


def test_sets_of_different_classes_cannot_be_joined() -> None:
    with pytest.raises(
        DataError,
        match="cannot stand in one set with objects of 9 classes with 'bathtub' and without 'drill'",
    ):
        ObjectSet.join([some(0), some(0, classes=PAPER_CLASSES)])


def test_a_prediction_is_printed_as_a_table_of_its_objects() -> None:
    objects = replace(some(2, 0), center=torch.tensor([[1.0, -2.0, 0.25], [0.0, 0.0, 0.0]]))
    objects = replace(objects, size=torch.full((2, 3), 0.5), score=torch.tensor([0.9, 0.625]))
    scene = ScenePrediction("workshop", objects, torch.zeros(3), occupancy=torch.zeros(4, 4, 2))
    first, head, bench, drill, rest = repr(scene).splitlines()
    assert first == "ScenePrediction workshop: 2 objects"
    assert head.split()[:3] == ["class", "score", "centre"]
    assert " ".join(bench.split()) == "00 bench 0.90 1.00 -2.00 0.25 0.50 x 0.50 x 0.50"
    assert drill.split()[:3] == ["01", "drill", "0.62"]
    assert rest == "  with occupancy 4 x 4 x 2"
    assert "tensor(" not in repr(scene) + repr(objects)
    assert repr(replace(scene, objects=ObjectSet.empty(CLASSES), occupancy=None)).endswith(
        "workshop: 0 objects"
    )
    many = repr(some(*[0] * 240))
    assert len(many.splitlines()) == 103
    assert many.endswith("and 140 more")
