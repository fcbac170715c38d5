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
    for index, (probability, target) in enumerate(scenes):
        metric.update(probability, target, [f"scene{index}"])
    probability, target = (torch.cat(part).flatten() for part in zip(*scenes, strict=True))
    expected = binary_jaccard_index(probability, target.int(), threshold=threshold)
    torch.testing.assert_close(metric.compute().float(), expected)


def test_extremes():
    metric = ForegroundIoU()
    metric.update(torch.zeros(1, 2, 4, 4), torch.zeros(1, 2, 4, 4, dtype=torch.bool), ["a"])
    assert metric.compute() == 0
    metric.update(torch.full((1, 1, 4, 4), 0.6), torch.ones(1, 1, 4, 4, dtype=torch.bool), ["b"])
    assert metric.compute() == 1
    metric.update(torch.full((1, 1, 4, 4), 0.5), torch.ones(1, 1, 4, 4, dtype=torch.bool), ["c"])  # not above
    assert metric.compute() == 0.5


def test_a_scene_counts_once():
    probability, target = torch.tensor([[1.0, 0.0]]), torch.tensor([[True, True]])
    metric = SceneOccupancyIoU()
    for name in ("a", "b", "a"):
        metric.update(probability, target, [name])
    metric.update(torch.ones(1, 2), target, ["c"])
    assert metric.compute().item() == 4 / 6


def test_nothing_seen():
    assert SceneOccupancyIoU().compute() == 0


def test_counts_beyond_single_precision():
    metric = SceneOccupancyIoU()
    count = 2**24 + 1  # float32 has no such number
    metric.update(
        torch.ones(1, 1).expand(1, count), torch.ones(1, 1, dtype=torch.bool).expand(1, count), ["a"]
    )
    metric.to(torch.bfloat16)
    metric.update(torch.ones(1, 1), torch.zeros(1, 1, dtype=torch.bool), ["b"])
    assert metric.compute().item() == count / (count + 1)


def test_shapes_are_checked():
    with pytest.raises(ShapeError, match="one shape"):
        SceneOccupancyIoU().update(torch.zeros(1, 2, 2, 2), torch.zeros(2, 2, 2, dtype=torch.bool), ["a"])
    with pytest.raises(ShapeError, match="a name for each scene"):
        SceneOccupancyIoU().update(torch.zeros(1, 2, 2, 2), torch.zeros(1, 2, 2, 2), ["a", "b"])
