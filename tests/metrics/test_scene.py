# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch
from torchmetrics.functional.classification import binary_jaccard_index

from raytran.errors import ShapeError
from raytran.metrics import ForegroundIoU, SceneOccupancyIoU


@pytest.mark.parametrize(
    ("metric_class", "shape"), [(SceneOccupancyIoU, (5, 4, 3)), (ForegroundIoU, (3, 6, 8))]
)
@pytest.mark.parametrize("threshold", [0.5, 0.3])
def test_iou_is_pooled_over_scenes(metric_class, shape, threshold, generator):
    scenes = [
        (torch.rand(1, *shape, generator=generator), torch.rand(1, *shape, generator=generator) > share)
        for share in (0.2, 0.9, 1.1)
    ]
    metric = metric_class(threshold=threshold)
    for probability, target in scenes:
        metric.update(probability, target)
    probability, target = (torch.cat(part).flatten() for part in zip(*scenes, strict=True))
    expected = binary_jaccard_index(probability, target.int(), threshold=threshold)
    torch.testing.assert_close(metric.compute(), expected)


def test_extremes():
    metric = ForegroundIoU()
    metric.update(torch.zeros(1, 2, 4, 4), torch.zeros(1, 2, 4, 4, dtype=torch.bool))
    assert metric.compute() == 0
    metric.update(torch.full((1, 1, 4, 4), 0.6), torch.ones(1, 1, 4, 4, dtype=torch.bool))
    assert metric.compute() == 1
    metric.update(torch.full((1, 1, 4, 4), 0.5), torch.ones(1, 1, 4, 4, dtype=torch.bool))  # not above ½
    assert metric.compute() == 0.5


def test_counts_beyond_single_precision():
    metric = SceneOccupancyIoU()
    metric.update(torch.ones(1), torch.ones(1, dtype=torch.bool))
    metric.intersection += 2**40
    metric.union += 2**41
    assert metric.compute().item() == pytest.approx(0.5)
    assert metric.intersection.item() == 2**40 + 1


def test_shapes_are_checked():
    with pytest.raises(ShapeError, match="one shape"):
        SceneOccupancyIoU().update(torch.zeros(1, 2, 2, 2), torch.zeros(2, 2, 2, dtype=torch.bool))
