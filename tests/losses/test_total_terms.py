# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.losses.total import shape_loss, view_loss
from raytran.structs import Views


def test_mean_over_cells_sum_over_objects() -> None:
    target = torch.zeros(2, 3, 3, 3, dtype=torch.bool)
    target[:, 1, 1, 1] = True
    logits = torch.zeros(2, 3, 3, 3)
    assert float(shape_loss(logits, target, num_objects=torch.tensor(1.0))) == pytest.approx(2 * 0.6931472)
    logits[1] = torch.where(target[1], 30.0, -30.0)
    assert float(shape_loss(logits, target, num_objects=torch.tensor(2.0))) == pytest.approx(0.6931472 / 2)


def views_of(images: torch.Tensor) -> Views:
    lead = images.shape[:2]
    return Views(images, torch.eye(3).expand(*lead, 3, 3), torch.eye(4).expand(*lead, 4, 4))


def test_mean_squared_error_of_colours() -> None:
    logits = torch.full((1, 2, 3, 4, 4), 0.0)  # mid-grey
    black = views_of(torch.zeros(1, 2, 3, 4, 4, dtype=torch.uint8))
    torch.testing.assert_close(view_loss(logits, black), torch.tensor(0.25))
    white = views_of(torch.full((1, 2, 3, 4, 4), 255, dtype=torch.uint8))
    torch.testing.assert_close(view_loss(torch.full_like(logits, 20.0), white), torch.tensor(0.0))


def test_a_mask_channel_is_no_colour_and_16_bits_suffice() -> None:
    logits = torch.zeros(1, 1, 3, 4, 4, dtype=torch.bfloat16)
    with_mask = views_of(torch.cat([torch.zeros(1, 1, 3, 4, 4), torch.ones(1, 1, 1, 4, 4)], dim=2))
    loss = view_loss(logits, with_mask)
    assert loss.dtype == torch.float32
    torch.testing.assert_close(loss, torch.tensor(0.25))


def test_shapes_that_are_not_known_count_nothing(generator):
    logits = torch.randn(3, 5, 5, 5, generator=generator)
    target = torch.rand(3, 5, 5, 5, generator=generator) > 0.5
    target[1] = False
    count = torch.tensor(2.0)
    loss = shape_loss(logits, target, num_objects=count)
    torch.testing.assert_close(loss, shape_loss(logits[[0, 2]], target[[0, 2]], num_objects=count))
    logits.requires_grad_()
    shape_loss(logits, target, num_objects=count).backward()
    assert not logits.grad[1].any()
    assert logits.grad[0].any()
