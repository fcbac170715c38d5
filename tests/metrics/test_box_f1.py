# SPDX-License-Identifier: Apache-2.0
"""Oriented-box F1 against a slow computation on boxes along the axes, whose IoU has a closed form."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from raytran.errors import ConfigError
from raytran.geometry.rotation import rotation_from_yaw
from raytran.metrics import OrientedBoxF1
from raytran.structs import ObjectSet


def upright(label, center, size, score=None) -> ObjectSet:
    count = len(label)
    return ObjectSet(
        label=torch.as_tensor(label, dtype=torch.int64).reshape(count),
        center=torch.as_tensor(np.array(center), dtype=torch.float64).reshape(count, 3),
        size=torch.as_tensor(np.array(size), dtype=torch.float64).reshape(count, 3),
        rotation=rotation_from_yaw(torch.zeros(count, dtype=torch.float64)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count)
        if score is None
        else torch.as_tensor(score, dtype=torch.float64).reshape(count),
    )


def random_scene(rng: np.random.Generator) -> tuple[ObjectSet, ObjectSet]:
    count = int(rng.integers(0, 8))
    center, size = rng.uniform(0, 1.5, (count, 3)), rng.uniform(0.5, 1.5, (count, 3))
    target = upright(rng.integers(0, 2, count), center, size)
    source = rng.integers(0, max(count, 1), int(rng.integers(0, 15)) if count else 0)
    prediction = upright(
        np.where(rng.random(len(source)) < 0.9, target.label[source].numpy(), 8),
        center[source] + rng.normal(size=(len(source), 3)) * 0.1,
        size[source] * rng.uniform(0.7, 1.3, (len(source), 3)),
        rng.choice([0.2, 0.5, 0.5, 0.6, 0.8, 0.95], len(source)),
    )
    return prediction, target


def slow_iou(a: ObjectSet, i: int, b: ObjectSet, j: int) -> float:
    def interval(s, k, axis):  # upright with yaw 0: the world's x, y, z are the object's x, -z, y
        half = s.size[k, (0, 2, 1)[axis]].item() / 2
        return s.center[k, axis].item() - half, s.center[k, axis].item() + half

    shared = 1.0
    for axis in range(3):
        (low_a, high_a), (low_b, high_b) = interval(a, i, axis), interval(b, j, axis)
        shared *= max(min(high_a, high_b) - max(low_a, low_b), 0.0)
    return shared / (a.size[i].prod().item() + b.size[j].prod().item() - shared)


def slow_counts(scenes, threshold: float, lowest_score: float) -> tuple[int, int, int]:
    """Number matched, predicted and true when predictions below a score are thrown away before matching."""
    matched = predicted = true = 0
    for prediction, target in scenes:
        kept = [i for i in range(len(prediction)) if prediction.score[i] >= lowest_score]
        predicted, true, used = predicted + len(kept), true + len(target), set()
        for i in sorted(kept, key=lambda i: -prediction.score[i].item()):
            same = [j for j in range(len(target)) if prediction.label[i] == target.label[j] and j not in used]
            if same and (best := max((slow_iou(prediction, i, target, j), -j) for j in same))[0] > threshold:
                used.add(-best[1])
        matched += len(used)
    return matched, predicted, true


def of_class(scenes, label: int):
    return [tuple(side.select(side.label == label) for side in scene) for scene in scenes]


def slow_average_precision(scenes, threshold: float) -> float:
    """Area under the best precision at each recall or above, one recall step of 1 / n at a time."""
    points = [
        (matched / true, matched / predicted)
        for level in {s for p, _ in scenes for s in p.score.tolist()}
        for matched, predicted, true in [slow_counts(scenes, threshold, level)]
    ]
    true = slow_counts(scenes, threshold, -1.0)[2]
    steps = [(k + 0.5) / true for k in range(true)]
    return sum(max((p for r, p in points if r > step), default=0.0) for step in steps) / true


def test_equals_slow_computation():
    rng = np.random.default_rng(0)
    scenes = [random_scene(rng) for _ in range(30)]
    metric = OrientedBoxF1(iou_thresholds=(0.25, 0.5))
    names = [str(i) for i in range(30)]
    for start, stop in ((0, 1), (1, 20), (20, 30)):
        metric.update(*zip(*scenes[start:stop], strict=True), names[start:stop])
    result = metric.compute()
    assert list(result["per_threshold"]) == ["0.25", "0.5"]
    for key, scores in result["per_threshold"].items():
        matched, predicted, true = slow_counts(scenes, float(key), -1.0)
        assert (scores["n_matched"], scores["n_predicted"], scores["n_true"]) == (matched, predicted, true)
        assert 0.1 < matched / predicted < 0.9  # the scenes say something
        assert scores["precision"] == pytest.approx(matched / predicted)
        assert scores["recall"] == pytest.approx(matched / true)
        assert scores["f1"] == pytest.approx(2 / (predicted / matched + true / matched))

        levels = sorted({s for p, _ in scenes for s in p.score.tolist()}, reverse=True)
        f1 = {
            level: (m / (p + t), m, p)
            for level in levels
            for m, p, t in [slow_counts(scenes, float(key), level)]
        }
        best = max(levels, key=lambda level: f1[level][0])
        assert scores["best"]["score_threshold"] == best
        assert scores["best"]["f1"] == pytest.approx(2 * f1[best][0])
        assert (scores["best"]["n_matched"], scores["best"]["n_predicted"]) == f1[best][1:]
        assert scores["average_precision"] == pytest.approx(slow_average_precision(scenes, float(key)))
        by_class = [slow_average_precision(of_class(scenes, label), float(key)) for label in (0, 1)]
        assert scores["mean_average_precision"] == pytest.approx(sum(by_class) / 2)
        assert 0.1 < scores["average_precision"] < 0.9


def test_threshold_is_exclusive():
    cube, half = upright([0], [0, 0, 0], [1, 1, 1]), upright([0], [0, 0, 0], [0.5, 1, 1])
    metric = OrientedBoxF1(iou_thresholds=(0.5, 0.4999))
    metric.update([half], [cube], ["scene"])
    scores = metric.compute()["per_threshold"]
    assert (scores["0.5"]["n_matched"], scores["0.4999"]["n_matched"]) == (0, 1)


def test_one_prediction_takes_one_object_and_prefers_the_better():
    target = upright([0, 0], [[0, 0, 0], [0.2, 0, 0]], [[1, 1, 1], [1, 1, 1]])
    prediction = upright([0, 0], [[0.15, 0, 0], [0.1, 0, 0]], [[1, 1, 1], [1, 1, 1]], [0.9, 0.8])
    metric = OrientedBoxF1()
    metric.update([prediction.select(torch.tensor([0]))], [target], ["one"])
    assert [row["matched_0.5"] for row in metric.rows()] == [False, True]
    metric.update([prediction], [target], ["two"])
    assert metric.compute()["per_threshold"]["0.5"]["n_matched"] == 3


def test_the_truth_itself_is_perfect(generator):
    count = 40
    truth = ObjectSet(
        label=torch.randint(0, 9, (count,), generator=generator),
        center=torch.randn(count, 3, generator=generator),
        size=torch.rand(count, 3, generator=generator) + 0.01,
        rotation=rotation_from_yaw(torch.randn(count, generator=generator)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
    )
    metric = OrientedBoxF1(iou_thresholds=(0.25, 0.5, 0.999))
    metric.update([truth], [truth], ["scene"])
    assert all(scores["f1"] == 1.0 for scores in metric.compute()["per_threshold"].values())


def test_best_threshold_drops_false_alarms_and_ignores_nan_scores():
    target = upright([0, 0], [[0, 0, 0], [3, 0, 0]], [[1, 1, 1], [1, 1, 1]])
    centers = [[0, 0, 0], [9, 0, 0], [3, 0, 0], [8, 0, 0], [7, 0, 0]]
    prediction = upright([0] * 5, centers, [[1, 1, 1]] * 5, [0.9, 0.8, 0.7, 0.6, np.nan])
    metric = OrientedBoxF1()
    metric.update([prediction], [target], ["scene"])
    scores = metric.compute()["per_threshold"]["0.5"]
    assert scores["precision"] == pytest.approx(2 / 5)
    assert scores["best"]["score_threshold"] == pytest.approx(0.7)
    assert scores["best"]["precision"] == pytest.approx(2 / 3)
    assert scores["average_precision"] == pytest.approx(1 / 2 + 2 / 3 / 2)


def test_scenes_without_predictions_or_objects():
    target, none = upright([0], [0, 0, 0], [1, 1, 1]), ObjectSet.empty()
    metric = OrientedBoxF1()
    metric.update([none, target, none], [target, none, none], ["a", "b", "c"])
    scores = metric.compute()["per_threshold"]["0.25"]
    assert (scores["n_true"], scores["n_predicted"], scores["n_matched"], scores["f1"]) == (1, 1, 0, 0.0)
    assert scores["average_precision"] == scores["mean_average_precision"] == 0.0
    assert metric.rows("scene") == [
        {"scene_id": scene, "n_predicted": p, "n_true": t, "n_matched_0.25": 0, "n_matched_0.5": 0}
        for scene, p, t in (("a", 0, 1), ("b", 1, 0), ("c", 0, 0))
    ]


def test_errors():
    with pytest.raises(ConfigError, match="strict"):
        OrientedBoxF1(protocol="loose")
    with pytest.raises(ConfigError, match="at least one"):
        OrientedBoxF1(iou_thresholds=())


def test_updates_may_come_in_any_order():
    rng = np.random.default_rng(1)
    scenes = [(*random_scene(rng), str(i)) for i in range(4)]
    results = []
    for order in itertools.islice(itertools.permutations(scenes), 0, 24, 7):
        metric = OrientedBoxF1()
        for prediction, target, name in order:
            metric.update([prediction], [target], [name])
        results.append(metric.compute())
    assert all(result == results[0] for result in results)
