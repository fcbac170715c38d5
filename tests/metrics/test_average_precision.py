# SPDX-License-Identifier: Apache-2.0
"""Mean average precision against plain loops over boxes, and against cases counted by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from raytran.classes import Classes
from raytran.errors import ConfigError
from raytran.geometry.rotation import rotation_from_yaw
from raytran.metrics import MeanAveragePrecision
from raytran.metrics.average_precision import mean_of_draws
from raytran.structs import ObjectSet

NAMES = ("bed", "chair", "night stand", "window")
KINDS = Classes(NAMES)


def boxes(label, center, *, size=1.0, yaw=0.0, score=1.0) -> ObjectSet:
    """Upright boxes; ``size`` is (along the yaw, across it, up), in an object frame whose z is up."""
    count = len(label)

    def column(value, *shape):
        return torch.as_tensor(np.array(value, dtype=np.float64)).expand(count, *shape).clone()

    # Its own z is up: `rotation_from_yaw` is for objects whose y is.
    turn = rotation_from_yaw(column(yaw))[..., [0, 2, 1]] * torch.tensor(
        [1.0, -1.0, 1.0], dtype=torch.float64
    )
    return ObjectSet(
        label=torch.as_tensor(label, dtype=torch.int64).reshape(count),
        center=torch.as_tensor(np.array(center, dtype=np.float64)).reshape(count, 3),
        size=column(size, 3),
        rotation=turn,
        symmetry=torch.ones(count, dtype=torch.int64),
        score=column(score),
        classes=KINDS,
    )


def random_scene(rng: np.random.Generator, *, turned: bool, ties: bool) -> tuple[ObjectSet, ObjectSet]:
    """Detections, some of them twice, of another class, or of nothing, and what is there."""
    count = int(rng.integers(0, 9))
    label, center = rng.integers(0, 3, count), rng.uniform(0, 2.0, (count, 3))
    size, yaw = rng.uniform(0.4, 1.5, (count, 3)), rng.uniform(0, 6, count) * turned
    source = rng.integers(0, count, int(rng.integers(0, 25))) if count else np.zeros(0, dtype=np.int64)
    noise = rng.normal(size=(len(source), 3)) * rng.choice([0.02, 0.1, 0.3], (len(source), 1))
    found = boxes(
        np.where(rng.random(len(source)) < 0.8, label[source], rng.integers(0, 4, len(source))),
        center[source] + noise,
        size=size[source] * rng.uniform(0.7, 1.3, (len(source), 3)),
        yaw=yaw[source] + rng.normal(size=len(source)) * 0.2 * turned,
        score=rng.choice([0.1, 0.5, 0.5, 0.9], len(source)) if ties else rng.random(len(source)),
    )
    return found, boxes(label, center, size=size, yaw=yaw)


def corners_from_above(one: ObjectSet, index: int) -> list[tuple[float, float]]:
    """The corners of an upright box in the plan, counter-clockwise."""
    x, y, _ = one.center[index].tolist()
    along, across, _ = one.size[index].tolist()
    cos, sin = one.rotation[index, 0, 0].item(), one.rotation[index, 1, 0].item()
    signs = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    return [
        (x + (i * along * cos - j * across * sin) / 2, y + (i * along * sin + j * across * cos) / 2)
        for i, j in signs
    ]


def area(polygon: list[tuple[float, float]]) -> float:
    turned = [*polygon[1:], *polygon[:1]]
    return sum(ax * by - bx * ay for (ax, ay), (bx, by) in zip(polygon, turned, strict=True)) / 2


def clipped(polygon, start, end):
    """The part of a polygon to the left of a line."""

    def side(point):
        return (end[0] - start[0]) * (point[1] - start[1]) - (end[1] - start[1]) * (point[0] - start[0])

    kept = []
    for index, point in enumerate(polygon):
        before = polygon[index - 1]
        if (side(before) >= 0) != (side(point) >= 0):
            share = side(before) / (side(before) - side(point))
            kept.append(tuple(a + share * (b - a) for a, b in zip(before, point, strict=True)))
        if side(point) >= 0:
            kept.append(point)
    return kept


def overlap_from_above(a: ObjectSet, i: int, b: ObjectSet, j: int, form: str) -> tuple[float, float, float]:
    """Area shared in the plan, and the areas of both."""
    first, second = corners_from_above(a, i), corners_from_above(b, j)
    if form == "axis_aligned":
        hulls = []
        for polygon in (first, second):
            xs, ys = zip(*polygon, strict=True)
            low_x, high_x, low_y, high_y = min(xs), max(xs), min(ys), max(ys)
            hulls.append([(low_x, low_y), (high_x, low_y), (high_x, high_y), (low_x, high_y)])
        first, second = hulls
    shared = first
    for start, end in zip(second, [*second[1:], second[0]], strict=True):
        shared = clipped(shared, start, end)
    return area(shared) if len(shared) > 2 else 0.0, area(first), area(second)


def slow_iou(a: ObjectSet, i: int, b: ObjectSet, j: int, form: str) -> float:
    shared, first, second = overlap_from_above(a, i, b, j, form)
    ends = [(s.center[k, 2].item(), s.size[k, 2].item()) for s, k in ((a, i), (b, j))]
    height = min(z + h / 2 for z, h in ends) - max(z - h / 2 for z, h in ends)
    volume = shared * max(height, 0.0)
    return volume / (first * ends[0][1] + second * ends[1][1] - volume) if volume > 0 else 0.0


def slow_average_precision(scenes, label: int, threshold: float, form: str) -> tuple[float, float]:
    """Average precision and recall of a class, one detection after another; scenes are sorted by name."""
    detections = [
        (found.score[i].item(), number, i)
        for number, (found, _) in enumerate(scenes)
        for i in range(len(found))
        if found.label[i] == label
    ]
    detections.sort(key=lambda one: -one[0])  # Python's sort keeps the order of equals
    n_true = sum(int((true.label == label).sum()) for _, true in scenes)
    used: set[tuple[int, int]] = set()
    curve = []
    for place, (_, number, i) in enumerate(detections, start=1):
        found, true = scenes[number]
        best, choice = -1.0, None
        for j in range(len(true)):
            if true.label[j] == label and (iou := slow_iou(found, i, true, j, form)) > best:
                best, choice = iou, j
        if best > threshold and (number, choice) not in used:
            used.add((number, choice))
        curve.append((len(used) / n_true, len(used) / place))
    area, reached = 0.0, 0.0
    for index, (recall, _) in enumerate(curve):
        if recall > reached:
            area += (recall - reached) * max(precision for _, precision in curve[index:])
            reached = recall
    return area, reached


@pytest.mark.parametrize("form", ["oriented", "axis_aligned"])
@pytest.mark.parametrize("ties", [False, True])
def test_equals_plain_loops(form, ties):
    rng = np.random.default_rng(7)
    for turned in (True, False):
        scenes = [random_scene(rng, turned=turned, ties=ties) for _ in range(12)]
        names = [f"scene{number:02}" for number in range(12)]
        metric = MeanAveragePrecision(boxes=form, classes=KINDS)
        shuffled = rng.permutation(12).tolist()  # as scenes arrive from several ranks
        for some in (shuffled[:5], shuffled[5:]):
            metric.update(
                *zip(*[scenes[index] for index in some], strict=True), [names[index] for index in some]
            )
        result = metric.compute()
        labels = sorted({label for _, true in scenes for label in true.label.tolist()})
        for threshold in (0.25, 0.5):
            expected = {NAMES[k]: slow_average_precision(scenes, k, threshold, form) for k in labels}
            of_threshold = result[f"iou_{threshold}"]
            assert of_threshold["per_class"] == pytest.approx(
                {name: precision for name, (precision, _) in expected.items()}, abs=1e-12
            )
            assert of_threshold["recall_per_class"] == pytest.approx(
                {name: recall for name, (_, recall) in expected.items()}, abs=1e-12
            )
            mean = sum(precision for precision, _ in expected.values()) / len(expected)
            assert of_threshold["mean"] == pytest.approx(mean, abs=1e-12)
            assert 0.05 < mean < 0.95  # the scenes say something
        assert result["n_true"].keys() == expected.keys()


def judged(*scenes, **settings):
    metric = MeanAveragePrecision(classes=KINDS, **settings)
    metric.update([found for found, _ in scenes], [true for _, true in scenes], list("abcdef"[: len(scenes)]))
    return metric.compute()


def test_by_hand():
    """Right, wrong, right, wrong, right of four: precision 1, 2/3 and 3/5 at recalls of a quarter each."""
    true = boxes([1] * 4, [[0, 0, 0], [3, 0, 0], [6, 0, 0], [9, 0, 0]])
    found = boxes(
        [1] * 5, [[0, 0, 0], [1, 9, 0], [3, 0, 0], [2, 9, 0], [6, 0, 0]], score=[0.9, 0.8, 0.7, 0.6, 0.5]
    )
    result = judged((found, true))
    assert result["iou_0.5"]["per_class"] == {"chair": pytest.approx((1 + 2 / 3 + 3 / 5) / 4)}
    assert result["iou_0.5"]["mean_recall"] == pytest.approx(3 / 4)
    assert (result["n_true"], result["n_predicted"]) == ({"chair": 4}, {"chair": 5})


def test_the_envelope_lifts_early_precision():
    """Wrong, right, right of two: precision 1/2 and 2/3, and 2/3 counts at both recalls."""
    true = boxes([0, 0], [[0, 0, 0], [3, 0, 0]])
    found = boxes([0] * 3, [[9, 0, 0], [0, 0, 0], [3, 0, 0]], score=[0.9, 0.8, 0.7])
    assert judged((found, true))["iou_0.25"]["mean"] == pytest.approx(2 / 3)


def test_no_second_choice_and_no_duplicates():
    """A detection whose best object is taken is wrong, though another object would do."""
    true = boxes([0, 0], [[0, 0, 0], [0.3, 0, 0]])
    found = boxes([0, 0], [[0.0, 0, 0], [0.1, 0, 0]], score=[0.9, 0.8])
    result = judged((found, true))["iou_0.25"]
    assert (result["mean"], result["mean_recall"]) == (0.5, 0.5)
    again = boxes([0, 0], [[0, 0, 0], [0, 0, 0]], score=[0.5, 0.9])
    assert judged((again, true.select(torch.tensor([0]))))["iou_0.5"]["mean"] == 1.0


def test_the_threshold_is_exclusive():
    half = boxes([0], [[0, 0, 0]], size=[0.5, 1, 1])
    for form in ("oriented", "axis_aligned"):
        result = judged((half, boxes([0], [[0, 0, 0]])), boxes=form, iou_thresholds=(0.5, 0.49))
        assert (result["iou_0.5"]["mean"], result["iou_0.49"]["mean"]) == (0.0, 1.0)


def test_classes_of_the_truth_count_and_no_others():
    """A bed is found; a night stand is not, and drags the mean; a window is not in the truth."""
    true = boxes([0, 2], [[0, 0, 0], [3, 0, 0]])
    found = boxes([0, 3, 3], [[0, 0, 0], [3, 0, 0], [6, 0, 0]])
    result = judged((found, true))
    assert result["iou_0.5"]["per_class"] == {"bed": 1.0, "night stand": 0.0}
    assert result["iou_0.5"]["mean"] == 0.5
    assert result["n_predicted"] == {"bed": 1, "night stand": 0}


def test_detections_where_nothing_is_annotated_are_wrong():
    one, none = boxes([0], [[0, 0, 0]], score=0.5), ObjectSet.empty()
    sure = boxes([0], [[0, 0, 0]], score=0.9)
    assert judged((one, one), (sure, none), (none, none))["iou_0.5"]["mean"] == 0.5
    assert judged((none, one))["iou_0.5"]["mean"] == 0.0
    assert judged((none, none))["iou_0.5"] == {
        "mean": 0.0,
        "per_class": {},
        "mean_recall": 0.0,
        "recall_per_class": {},
    }


def test_equals_come_by_scene_and_then_in_order():
    """The wrong one first: 1/2; the right one first: 1. Scenes count by their names, not as they come."""
    true, nothing = boxes([0], [[0, 0, 0]]), ObjectSet.empty()
    right, wrong = boxes([0], [[0, 0, 0]]), boxes([0], [[9, 0, 0]])
    for order in ([0, 1], [1, 0]):
        for names, expected in ((("a", "b"), 1.0), (("b", "a"), 0.5)):
            metric = MeanAveragePrecision(classes=KINDS)
            for index in order:
                metric.update([(right, wrong)[index]], [(true, nothing)[index]], [names[index]])
            assert metric.compute()["iou_0.25"]["mean"] == expected
    both = boxes([0, 0], [[9, 0, 0], [0, 0, 0]])
    assert judged((both, true))["iou_0.25"]["mean"] == 0.5
    assert judged((both.select(torch.tensor([1, 0])), true))["iou_0.25"]["mean"] == 1.0


def test_of_objects_that_overlap_as_much_the_first_is_taken():
    true = boxes([0, 0], [[0, 0, 0], [0, 0, 0]])
    metric = MeanAveragePrecision(classes=KINDS)
    metric.update([boxes([0, 0], [[0, 0, 0], [0, 0, 0]])], [true], ["a"])
    assert [row["matched_0.5"] for row in metric.rows()] == [True, False]
    assert metric.compute()["iou_0.5"]["mean"] == 0.5


@pytest.mark.parametrize("form", ["oriented", "axis_aligned"])
def test_boxes_without_volume(form):
    """They overlap with nothing, themselves included: a true one is an object that nobody finds."""
    flat = boxes([0, 0], [[0, 0, 0], [5, 0, 0]], size=[[1, 0, 1], [1, 1, 1]])
    result = judged((flat, flat), boxes=form)
    assert (result["iou_0.25"]["mean"], result["n_true"]["bed"]) == (pytest.approx(0.5 * 0.5), 2)
    lost = boxes([0], [[math.inf, 0, 0]])
    assert judged((lost, lost), boxes=form)["iou_0.25"]["mean"] == 0.0


def test_the_box_around_a_turned_box():
    """A square turned by 45 degrees and the square around it, of twice the area: IoU 1/2 or 1."""
    turned = boxes([0], [[1, 2, 0]], size=[1, 1, 1], yaw=math.pi / 4)
    around = boxes([0], [[1, 2, 0]], size=[math.sqrt(2), math.sqrt(2), 1])
    thresholds = (0.499, 0.501, 0.999)
    means = {
        form: [value["mean"] for name, value in result.items() if name.startswith("iou_")]
        for form in ("oriented", "axis_aligned")
        for result in [judged((turned, around), boxes=form, iou_thresholds=thresholds)]
    }
    assert means == {"oriented": [1.0, 0.0, 0.0], "axis_aligned": [1.0, 1.0, 1.0]}


def test_scenes_drawn_several_times_count_as_copies():
    rng = np.random.default_rng(3)
    scenes = [random_scene(rng, turned=True, ties=False) for _ in range(6)]
    metric = MeanAveragePrecision(classes=KINDS)
    metric.update(*zip(*scenes, strict=True), [str(number) for number in range(6)])
    for column, threshold in enumerate((0.25, 0.5)):
        of_draws = mean_of_draws(metric.scenes_by_name(), NAMES, column)
        drawn = np.array([[0, 1, 2, 3, 4, 5], [5, 5, 1, 0, 1, 5], [2, 2, 2, 2, 2, 2]])
        expected = []
        for draw in drawn.tolist():
            copies = MeanAveragePrecision(classes=KINDS)
            names = [f"{index}-{number}" for number, index in enumerate(draw)]
            copies.update(*zip(*[scenes[index] for index in draw], strict=True), names)
            expected.append(copies.compute()[f"iou_{threshold}"]["mean"])
        assert of_draws(drawn).tolist() == pytest.approx(expected, abs=1e-12)


def test_rows():
    true = boxes([1, 1], [[0, 0, 0], [5, 0, 0]])
    found = boxes([1, 0], [[0, 0, 0.5], [5, 0, 0]])
    metric = MeanAveragePrecision(classes=KINDS)
    metric.update([found], [true], ["a"])
    first, second = metric.rows("object")
    assert first.pop("best_iou") == pytest.approx(1 / 3)
    same = {"scene_id": "a", "category": "chair"}
    assert first == same | {"object": 0, "matched_0.25": True, "matched_0.5": False}
    assert second == same | {"object": 1, "best_iou": 0.0, "matched_0.25": False, "matched_0.5": False}
    assert metric.rows("scene") == [
        {"scene_id": "a", "n_predicted": 2, "n_true": 2, "n_matched_0.25": 1, "n_matched_0.5": 0}
    ]


def test_errors():
    with pytest.raises(ConfigError, match="unknown boxes=upright, choose one of: oriented, axis_aligned"):
        MeanAveragePrecision(boxes="upright")
    for thresholds in ((), (0.25, 1.0), (-0.1,)):
        with pytest.raises(ConfigError, match="must be shares below 1"):
            MeanAveragePrecision(iou_thresholds=thresholds)
