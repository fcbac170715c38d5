# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import itertools
import math
import statistics
import time

import pytest
import torch

from raytran.errors import ShapeError
from raytran.geometry import boxes as module
from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.geometry.rotation import rotation_from_yaw


def upright(centers, sizes, yaws=None) -> OrientedBoxes:
    center = torch.tensor(centers, dtype=torch.float64).reshape(-1, 3)
    size = torch.tensor(sizes, dtype=torch.float64).reshape(-1, 3)
    yaw = torch.zeros(len(center)) if yaws is None else torch.tensor(yaws, dtype=torch.float64)
    return OrientedBoxes(center, size, rotation_from_yaw(yaw.double()))


def random_boxes(count: int, generator: torch.Generator, spread: float = 0.3) -> OrientedBoxes:
    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    rotation, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    return OrientedBoxes((uniform(count, 3) - 0.5) * 2 * spread, uniform(count, 3) * 1.5 + 0.5, rotation)


def test_corners_are_numbered_x_major_and_z_fastest():
    box = upright([1.0, 2.0, 3.0], [2.0, 4.0, 6.0])
    # The object's y points along the world's z, and its z along the world's -y.
    signs = itertools.product((-1, 1), repeat=3)
    expected = [[1 + 1 * x, 2 - 3 * z, 3 + 2 * y] for x, y, z in signs]
    torch.testing.assert_close(box.corners()[0], torch.tensor(expected, dtype=torch.float64))
    assert box.volume().tolist() == [48.0]


def test_leading_shapes_are_kept():
    box = OrientedBoxes(torch.zeros(2, 5, 3), torch.ones(2, 5, 3), torch.eye(3).expand(2, 5, 3, 3))
    assert box.corners().shape == (2, 5, 8, 3)
    assert box.volume().shape == (2, 5)


@pytest.mark.parametrize(
    ("center", "size", "yaw", "shared"),
    [
        ([0.5, 0, 0], [1, 1, 1], 0.0, 0.5),
        ([0.25, 0.5, -0.5], [1, 1, 1], 0.0, 0.75 * 0.5 * 0.5),
        ([0, 0, 0], [1, 1, 1], math.pi / 4, 2 * (math.sqrt(2) - 1)),
        ([0, 0, 0], [1, 1, 1], math.pi / 2, 1.0),
        ([0.1, 0, 0.1], [0.5, 0.5, 0.5], 0.3, 0.125),
        ([1, 0, 0], [1, 1, 1], 0.0, 0.0),
        ([5, 0, 0], [1, 1, 1], 0.5, 0.0),
    ],
)
def test_closed_forms(center, size, yaw, shared):
    iou, intersection = box_iou(upright([0.0, 0, 0], [1.0, 1, 1]), upright(center, size, [yaw]))
    assert intersection.item() == pytest.approx(shared, abs=1e-12)
    assert iou.item() == pytest.approx(shared / (1 + math.prod(size) - shared), abs=1e-12)


def test_all_pairs_equal_single_pairs(generator, monkeypatch):
    a, b = random_boxes(5, generator), random_boxes(7, generator)
    monkeypatch.setattr(module, "_PAIRS_PER_CHUNK_CPU", 4)
    table, shared = box_iou(a, b)
    assert table.shape == shared.shape == (5, 7)
    for i, j in itertools.product(range(5), range(7)):
        one = box_iou(
            *(
                OrientedBoxes(s.center[k : k + 1], s.size[k : k + 1], s.rotation[k : k + 1])
                for s, k in ((a, i), (b, j))
            )
        )
        assert table[i, j].item() == pytest.approx(one[0].item(), abs=1e-14)


@pytest.mark.parametrize(("count_a", "count_b"), [(0, 3), (3, 0), (0, 0)])
def test_no_boxes(count_a, count_b, generator):
    a, b = random_boxes(count_a, generator), random_boxes(count_b, generator)
    a.center.requires_grad_()
    iou, shared = box_iou(a, b)
    assert iou.shape == shared.shape == (count_a, count_b)
    (iou.sum() + shared.sum()).backward()
    assert a.center.grad.isfinite().all()


def test_gradients_match_differences(generator):
    a, b = random_boxes(2, generator), random_boxes(3, generator)
    inputs = [value.requires_grad_() for s in (a, b) for value in (s.center, s.size, s.rotation)]
    assert torch.autograd.gradcheck(
        lambda *v: box_iou(OrientedBoxes(*v[:3]), OrientedBoxes(*v[3:])), inputs, eps=1e-6, atol=1e-8
    )


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e200, 0.0, 1e-200])
@pytest.mark.parametrize("part", ["center", "size", "rotation"])
def test_bad_numbers_give_zero_and_leave_the_others_alone(part, bad, generator):
    a, b = random_boxes(3, generator), random_boxes(4, generator)
    expected, _ = box_iou(a, b)
    getattr(a, part)[1] = bad
    inputs = [value.requires_grad_() for s in (a, b) for value in (s.center, s.size, s.rotation)]
    iou, shared = box_iou(a, b)
    if part != "center" or abs(bad) > 1 or math.isnan(bad):
        assert (iou[1] == 0).all()
        assert (shared[1] == 0).all()
    torch.testing.assert_close(iou[[0, 2]], expected[[0, 2]])
    (iou.sum() + shared.sum()).backward()
    assert all(value.grad.isfinite().all() for value in inputs)


def test_float64_inside_for_float32_input_and_under_autocast(generator):
    a, b = random_boxes(3, generator), random_boxes(3, generator)
    a32, b32 = (OrientedBoxes(s.center.float(), s.size.float(), s.rotation.float()) for s in (a, b))
    expected, _ = box_iou(a, b)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        iou, _ = box_iou(a32, b32)
    assert iou.dtype == torch.float64
    torch.testing.assert_close(iou, expected, rtol=0, atol=4e-7)


def test_shapes_are_checked():
    with pytest.raises(ShapeError, match="size"):
        OrientedBoxes(torch.zeros(1, 3), torch.zeros(1, 2), torch.zeros(1, 3, 3))
    with pytest.raises(ShapeError, match="as many centers"):
        OrientedBoxes(torch.zeros(1, 3), torch.zeros(2, 3), torch.zeros(1, 3, 3))
    single = OrientedBoxes(torch.zeros(3), torch.ones(3), torch.eye(3))
    with pytest.raises(ShapeError, match="first boxes"):
        box_iou(single, single)


@pytest.mark.parametrize(
    ("counts", "spread", "limit"),
    [((64, 30), 4.0, 0.05), ((64, 30), 0.3, 0.25), ((256, 100), 4.0, 0.30)],
    ids=["room", "dense", "large room"],
)
def test_speed_against_sorting_a_million_numbers(counts, spread, limit, generator):
    """A margin of four for busy machines; ``benchmarks/box_iou.py`` measures 0.03, 0.18 and 0.16."""
    a, b = (random_boxes(count, generator, spread) for count in counts)
    numbers = torch.rand(1_000_000, generator=generator, dtype=torch.float64)

    def median(function, repeats):
        times = []
        for _ in range(repeats):
            start = time.process_time()
            function()
            times.append(time.process_time() - start)
        return statistics.median(times)

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            assert median(lambda: box_iou(a, b), 7) < 4 * limit * median(numbers.sort, 3)
    finally:
        torch.set_num_threads(threads)
