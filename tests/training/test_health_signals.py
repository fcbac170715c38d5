# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.classes import PAPER_CLASSES
from raytran.geometry.rotation import rotation_from_yaw
from raytran.losses.matcher import HungarianMatcher
from raytran.structs import ObjectSet, RawObjects
from raytran.training.health_signals import gradient_norms, slot_signals

MATCHER = HungarianMatcher(weights={"class": 1.0, "center": 5.0, "size": 1.0, "yaw": 1.0})


def truth(*labels: int) -> ObjectSet:
    count = len(labels)
    return ObjectSet(
        label=torch.tensor(labels, dtype=torch.int64),
        center=torch.arange(count).float()[:, None].expand(count, 3),
        size=torch.ones(count, 3),
        rotation=rotation_from_yaw(torch.zeros(count)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
    )


def slots(*labels: int, sureness: float = 50.0) -> RawObjects:
    """Slots at (0, 0, 0), (1, 1, 1), …, each sure of a class."""
    count = len(labels)
    return RawObjects(
        class_logits=sureness
        * torch.nn.functional.one_hot(torch.tensor([labels]), len(PAPER_CLASSES) + 1).float(),
        center=torch.arange(count).float()[None, :, None].expand(1, count, 3),
        log_size=torch.zeros(1, count, 3),
        yaw_vector=torch.tensor([0.0, 1.0]).expand(1, count, 2),
        embedding=torch.zeros(1, count, 4),
    )


def test_matched_slots_are_judged_by_their_class() -> None:
    signals = slot_signals(slots(3, 5, len(PAPER_CLASSES), len(PAPER_CLASSES)), [truth(3, 6)], MATCHER)
    assert signals["class_accuracy"] == pytest.approx(0.5)
    assert signals["slots_used"] == pytest.approx(0.5)
    assert signals["class_entropy"] == pytest.approx(0.0, abs=1e-6)


def test_undecided_slots_have_all_the_entropy() -> None:
    signals = slot_signals(slots(3, 5, sureness=0.0), [truth(3)], MATCHER)
    assert signals["class_entropy"] == pytest.approx(1.0)


def test_a_scene_without_objects_has_no_accuracy() -> None:
    signals = slot_signals(slots(len(PAPER_CLASSES), 2), [truth()], MATCHER)
    assert set(signals) == {"class_entropy", "slots_used"}


def test_gradients_are_summed_by_part() -> None:
    model = torch.nn.ModuleDict(
        {
            "backbone": torch.nn.Linear(2, 1),
            "heads": torch.nn.ModuleDict({"shape": torch.nn.Linear(1, 1, bias=False)}),
        }
    )
    model["backbone"].weight.grad = torch.tensor([[3.0, 0.0]])
    model["backbone"].bias.grad = torch.tensor([4.0])
    assert {name: float(norm) for name, norm in gradient_norms(model).items()} == {
        "backbone": 5.0,
        "all": 5.0,
    }
