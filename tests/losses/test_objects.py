# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest
import torch

from raytran.losses.matcher import Match
from raytran.losses.objects import object_losses
from raytran.losses.pose import Betas


@pytest.mark.parametrize("no_object_weight", [1.0, 0.1])
def test_padding_is_weighted(make_objects, make_perfect, no_object_weight: float) -> None:
    """Uniform logits cost log 10 whatever the weights; a wrong padding slot counts by its weight."""
    objects, slots = make_objects(1), torch.tensor([0])
    raw = make_perfect(objects, slots, 3)
    match = [Match(slots, torch.tensor([0]))]

    def class_loss() -> float:
        found = object_losses(
            raw,
            [objects],
            match,
            num_objects=torch.tensor(1.0),
            class_weight=torch.tensor(1 + 2 * no_object_weight),
            no_object_weight=no_object_weight,
            betas=Betas(),
        )
        return float(found["class"].detach())

    raw.class_logits.data.zero_()
    assert class_loss() == pytest.approx(math.log(10))
    raw.class_logits.data[0, 0, objects.label] = 100.0
    raw.class_logits.data[0, 1, 9] = 100.0
    assert class_loss() == pytest.approx(math.log(10) * no_object_weight / (1 + 2 * no_object_weight))
