# SPDX-License-Identifier: Apache-2.0
"""Batch norms whose batches are counted together end as those that count by themselves."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from raytran.training.norm_counters import batches_counted_together


def network():
    torch.manual_seed(0)
    plain, cumulative, frozen = nn.BatchNorm2d(3), nn.BatchNorm2d(3, momentum=None), nn.BatchNorm2d(3)
    without = nn.BatchNorm2d(3, track_running_stats=False)
    model = nn.Sequential(nn.Conv2d(3, 3, 1), plain, cumulative, frozen, without)
    frozen.eval()
    return model


def test_equals_norms_that_count():
    mine, expected = network(), network()
    for _ in range(2):
        images = torch.rand(2, 3, 4, 4)
        with batches_counted_together(mine):
            found = mine(images)
        assert torch.equal(found, expected(images))
    buffers = dict(expected.named_buffers())
    assert {name for name, _ in mine.named_buffers()} == set(buffers)
    for name, value in mine.named_buffers():
        assert torch.equal(value, buffers[name]), name
    assert [mine[i].num_batches_tracked for i in (1, 2, 3)] == [2, 2, 0]


def test_counters_come_back_after_an_error():
    model = network()
    with pytest.raises(ZeroDivisionError), batches_counted_together(model):
        raise ZeroDivisionError
    assert model[1].num_batches_tracked == 0
