# SPDX-License-Identifier: Apache-2.0
"""Shape scores against closed forms of blocks and against plain loops over all pairs of points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.errors import ShapeError
from raytran.geometry.rotation import rotation_from_yaw
from raytran.metrics import MatchedShapeScores, Scan2CADAccuracy
from raytran.metrics.functional.shape import chamfer_distance, grid_iou, surface_points
from raytran.structs import ObjectSet


def block(low: tuple[int, int, int], high: tuple[int, int, int], side: int = 8) -> torch.Tensor:
    grid = torch.zeros(side, side, side, dtype=torch.bool)
    grid[low[0] : high[0], low[1] : high[1], low[2] : high[2]] = True
    return grid


def make_objects(
    shapes: list[torch.Tensor], labels: list[int], scores: list[float] | None = None
) -> ObjectSet:
    count = len(shapes)
    return ObjectSet(
        label=torch.tensor(labels),
        center=torch.arange(count)[:, None] * torch.tensor([3.0, 0.0, 0.0]),
        size=torch.tensor([[0.8, 1.6, 0.4]]).expand(count, 3),
        rotation=rotation_from_yaw(torch.zeros(count)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count) if scores is None else torch.tensor(scores),
        shape=torch.stack(shapes),
    )


def slow_surface(grid: np.ndarray, size) -> list[np.ndarray]:
    side, points = len(grid), []
    for cell in np.argwhere(grid):
        neighbours = [cell + sign * np.eye(3, dtype=int)[axis] for axis in range(3) for sign in (-1, 1)]
        if any((n < 0).any() or (n >= side).any() or not grid[tuple(n)] for n in neighbours):
            points.append(((cell + 0.5) / side - 0.5) * size)
    return points


def slow_chamfer(a: list[np.ndarray], b: list[np.ndarray]) -> float:
    def directed(first, second):
        return sum(min(np.linalg.norm(p - q) for q in second) for p in first) / len(first)

    return (directed(a, b) + directed(b, a)) / 2


def test_equals_slow_computation(generator):
    size = torch.tensor([0.8, 1.6, 0.4], dtype=torch.float64)
    for _ in range(3):
        a, b = torch.rand(2, 6, 6, 6, generator=generator) > 0.3  # with holes inside and cells on the border
        a[1:5, 1:5, 1:5] = True
        slow = [slow_surface(grid.numpy(), size.numpy()) for grid in (a, b)]
        fast = [surface_points(grid, size) for grid in (a, b)]
        for expected, found in zip(slow, fast, strict=True):
            np.testing.assert_allclose(found.numpy(), np.array(expected), atol=1e-15)
        assert chamfer_distance(*fast) == pytest.approx(slow_chamfer(*slow), abs=1e-12)
        cells = [{tuple(cell) for cell in grid.nonzero().tolist()} for grid in (a, b)]
        assert grid_iou(a, b) == len(cells[0] & cells[1]) / len(cells[0] | cells[1])


def test_a_shifted_plate_is_as_far_as_its_shift():
    size = torch.tensor([0.8, 1.6, 0.4], dtype=torch.float64)
    low, high = block((0, 0, 0), (8, 1, 8)), block((0, 3, 0), (8, 4, 8))
    assert chamfer_distance(surface_points(low, size), surface_points(high, size)) == pytest.approx(0.6)
    assert grid_iou(low, high) == 0
    inside = surface_points(block((0, 0, 0), (8, 8, 8)), size)
    assert len(inside) == 8**3 - 6**3
    assert inside.abs().amax(dim=0).tolist() == pytest.approx([0.35, 0.7, 0.175])


def test_means_over_matched_objects():
    full, half = block((0, 0, 0), (8, 8, 8)), block((0, 0, 0), (4, 8, 8))
    truth = make_objects([full, full, full, half], [3, 3, 6, 6])
    found = make_objects([full.float(), 0.6 * half.float(), full.float(), torch.zeros(8, 8, 8)], [3, 3, 3, 6])
    metric = MatchedShapeScores()
    metric.update([found], [truth], ["a"])
    result = metric.compute()
    assert (result["n_matched"], result["n_empty"]) == (3, 1)  # the third is of another class
    assert result["iou"] == pytest.approx((1 + 0.5 + 0) / 3)
    assert result["per_class"]["chair"]["iou"] == pytest.approx(0.75)
    assert result["per_class"]["table"] == {"n_matched": 1, "iou": 0.0, "chamfer_distance": None}
    assert result["per_class"]["sofa"] == {"n_matched": 0, "iou": None, "chamfer_distance": None}
    size = truth.size[0].double()
    expected = chamfer_distance(surface_points(full, size), surface_points(half, size)) / 2
    assert result["chamfer_distance"] == pytest.approx(expected)
    assert [row["shape_iou"] for row in metric.rows()] == [1.0, 0.5, None, 0.0]
    assert metric.rows("scene") == [
        {"scene_id": "a", "shape_iou": result["iou"], "chamfer_distance_m": result["chamfer_distance"]}
    ]


def test_same_objects_as_the_strict_protocol(generator):
    grids = list(torch.rand(12, 8, 8, 8, generator=generator))
    truth = make_objects(
        [grid > 0.5 for grid in grids], torch.randint(0, 3, (12,), generator=generator).tolist()
    )
    found = replace(
        make_objects(grids, truth.label.tolist(), torch.rand(12, generator=generator).tolist()),
        center=truth.center + 0.12 * torch.randn(12, 3, generator=generator),
        size=truth.size * (1 + 0.15 * torch.randn(12, 1, generator=generator)),
    )
    shapes, accuracy = MatchedShapeScores(), Scan2CADAccuracy()
    for metric in (shapes, accuracy):
        metric.update([found], [truth], ["a"])
    matched = [row["matched"] for row in accuracy.rows()]
    assert 0 < sum(matched) < 12
    assert [row["shape_iou"] is not None for row in shapes.rows()] == matched


def test_no_predictions_and_no_objects():
    truth, none = make_objects([block((0, 0, 0), (1, 1, 1))], [0]), ObjectSet.empty()
    metric = MatchedShapeScores()
    metric.update([none, truth, none], [truth, none, none], ["a", "b", "c"])
    result = metric.compute()
    assert (result["n_matched"], result["iou"], result["chamfer_distance"]) == (0, None, None)
    assert [row["shape_iou"] for row in metric.rows()] == [None]


def test_missing_and_unlike_shapes():
    truth = make_objects([block((0, 0, 0), (1, 1, 1))], [0])
    with pytest.raises(ShapeError, match="decode"):
        MatchedShapeScores().update([replace(truth, shape=None)], [truth], ["a"])
    with pytest.raises(ShapeError, match="one size"):
        MatchedShapeScores().update([replace(truth, shape=torch.ones(1, 4, 4, 4))], [truth], ["a"])


def test_an_object_whose_shape_is_not_known_is_not_compared():
    full = block((0, 0, 0), (8, 8, 8))
    truth = make_objects([full, torch.zeros_like(full)], [1, 1])
    metric = MatchedShapeScores()
    metric.update([replace(truth, shape=torch.stack([full, full]))], [truth], ["a"])
    result = metric.compute()
    assert (result["n_matched"], result["iou"]) == (1, 1.0)
