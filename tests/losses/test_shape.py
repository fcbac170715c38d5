# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.losses.shape import shape_loss


def test_mean_over_cells_sum_over_objects() -> None:
    target = torch.zeros(2, 3, 3, 3, dtype=torch.bool)
    logits = torch.zeros(2, 3, 3, 3)
    assert float(shape_loss(logits, target, num_objects=torch.tensor(1.0))) == pytest.approx(2 * 0.6931472)
    logits[1] = -30.0
    assert float(shape_loss(logits, target, num_objects=torch.tensor(2.0))) == pytest.approx(0.6931472 / 2)
