# SPDX-License-Identifier: Apache-2.0
"""Scan2CAD accuracy against a slow computation with quaternions, and on scenes made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from raytran.classes import PAPER_CLASSES, Classes
from raytran.errors import ConfigError, DataError, ShapeError
from raytran.metrics import AccuracyCurves, ErrorAtlas, OrientedBoxF1, Scan2CADAccuracy
from raytran.structs import ObjectSet

UPRIGHT = Rotation.from_rotvec([np.pi / 2, 0, 0])
CHAIR, TABLE, BIN = (PAPER_CLASSES.index(name) for name in ("chair", "table", "trashbin"))


def objects(label, center, *, size=None, rotation=None, symmetry=None, score=None) -> ObjectSet:
    count = len(label)
    rotation = [UPRIGHT] * count if rotation is None else rotation
    size = [[1.0, 1.0, 1.0]] * count if size is None else size
    return ObjectSet(
        label=torch.tensor(label, dtype=torch.int64),
        center=torch.tensor(center, dtype=torch.float64).reshape(count, 3),
        size=torch.tensor(np.array(size), dtype=torch.float64).reshape(count, 3),
        rotation=torch.from_numpy(np.array([r.as_matrix() for r in rotation]).reshape(count, 3, 3)),
        symmetry=torch.tensor(symmetry if symmetry is not None else [1] * count, dtype=torch.int64),
        score=torch.tensor(score if score is not None else [1.0] * count, dtype=torch.float64),
    )


def about_up(degrees: float) -> Rotation:
    return Rotation.from_rotvec([0, np.radians(degrees), 0])


def tilted(degrees: float) -> Rotation:
    return Rotation.from_rotvec([np.radians(degrees), 0, 0])


def accuracy(prediction: ObjectSet, target: ObjectSet, **limits: float) -> float:
    metric = Scan2CADAccuracy(**limits)
    metric.update([prediction], [target], ["scene"])
    return metric.compute()["global_average"]


def random_scene(rng: np.random.Generator) -> tuple[ObjectSet, ObjectSet]:
    """Objects and noisy, partly mislabelled, tilted and wrongly turned copies of them, with equal scores."""
    count = int(rng.integers(0, 12))
    true = [tilted(rng.uniform(0, 5)) * UPRIGHT * about_up(rng.uniform(0, 360)) for _ in range(count)]
    target = objects(
        rng.integers(0, 4, count),
        rng.uniform(0, 1.0, (count, 3)),
        size=rng.uniform(0.4, 1.5, (count, 3)),
        rotation=true,
        symmetry=rng.choice([0, 1, 2, 4], count),
    )
    source = rng.integers(0, max(count, 1), int(rng.integers(0, 20)) if count else 0)
    turns = rng.choice([0, 0, 90, 180], len(source)) + rng.normal(size=len(source)) * 8
    prediction = objects(
        np.where(rng.random(len(source)) < 0.8, target.label[source].numpy(), 1),
        target.center[source].numpy() + rng.normal(size=(len(source), 3)) * 0.08,
        size=target.size[source].numpy() * rng.uniform(0.75, 1.25, (len(source), 3)),
        rotation=[
            tilted(rng.normal() * 8) * true[i] * about_up(t) for i, t in zip(source, turns, strict=True)
        ],
        score=rng.choice([0.1, 0.4, 0.4, 0.7, 0.9], len(source)),
    )
    return prediction, target


def slow_rotation_error(predicted: Rotation, true: Rotation, symmetry: int) -> float:
    """The benchmark's 2 acos |q · q'| over the object's turns; a comb of 0.01 degrees stands for infinite."""
    steps = 36_000 if symmetry == 0 else symmetry
    turns = true * Rotation.from_rotvec(np.arange(steps)[:, None] * [0, 2 * np.pi / steps, 0])
    dots = np.abs(turns.as_quat() @ predicted.as_quat()).clip(max=1)
    return float(np.degrees(2 * np.arccos(dots)).min())


def slow_counts(scenes) -> tuple[dict[int, int], dict[int, int]]:
    good = dict.fromkeys(range(len(PAPER_CLASSES)), 0)
    total = dict.fromkeys(range(len(PAPER_CLASSES)), 0)
    for prediction, target in scenes:
        free = list(range(len(target)))
        for label in target.label.tolist():
            total[label] += 1
        ranked = sorted(range(len(prediction)), key=lambda i: -prediction.score[i].item())
        for i in ranked:
            for j in free:
                if prediction.label[i] != target.label[j]:
                    continue
                shift = np.linalg.norm(prediction.center[i].numpy() - target.center[j].numpy())
                ratio = np.mean(prediction.size[i].numpy() / target.size[j].numpy())
                angle = slow_rotation_error(
                    Rotation.from_matrix(prediction.rotation[i].numpy()),
                    Rotation.from_matrix(target.rotation[j].numpy()),
                    int(target.symmetry[j]),
                )
                if shift <= 0.2 and angle <= 20 and abs(ratio - 1) <= 0.2:
                    good[int(target.label[j])] += 1
                    free.remove(j)
                    break
    return good, total


def test_equals_slow_computation():
    rng = np.random.default_rng(3)
    scenes = [random_scene(rng) for _ in range(25)]
    good, total = slow_counts(scenes)
    metric = Scan2CADAccuracy()
    names = [f"scene{i:04d}_00" for i in range(len(scenes))]
    metric.update(*zip(*scenes[:10], strict=True), names[:10])
    metric.update(*zip(*scenes[10:], strict=True), names[10:])
    result = metric.compute()

    assert 0.2 < sum(good.values()) / sum(total.values()) < 0.9  # the scenes say something
    for label, name in enumerate(PAPER_CLASSES.names):
        assert result["per_class"][name]["n_good"] == good[label]
        assert result["per_class"][name]["n_total"] == total[label]
    occurring = [label for label in total if total[label]]
    assert result["class_average"] == pytest.approx(np.mean([good[k] / total[k] for k in occurring]))
    assert result["global_average"] == pytest.approx(sum(good.values()) / sum(total.values()))
    assert result["n_scenes"] == 25


@pytest.mark.parametrize(
    ("symmetry", "turn", "found"),
    [
        *((1, 19, 1), (1, 21, 0), (1, 180, 0), (2, 180, 1), (2, 90, 0), (2, 199, 1)),
        *((4, 90, 1), (4, 270, 1), (4, 45, 0), (0, 33, 1), (0, 77, 1), (0, 180, 1)),
    ],
)
def test_symmetry_about_up(symmetry, turn, found):
    target = objects([BIN], [0, 0, 0], symmetry=[symmetry])
    prediction = objects([BIN], [0, 0, 0], rotation=[UPRIGHT * about_up(turn)])
    assert accuracy(prediction, target) == found


@pytest.mark.parametrize("symmetry", [0, 1, 2, 4])
@pytest.mark.parametrize(("tilt", "found"), [(19, 1), (21, 0)])
def test_tilt_of_the_truth_counts(symmetry, tilt, found):
    target = objects([BIN], [0, 0, 0], rotation=[tilted(tilt) * UPRIGHT], symmetry=[symmetry])
    assert accuracy(objects([BIN], [0, 0, 0]), target) == found


def test_symmetry_of_a_prediction_is_ignored():
    prediction = objects([BIN], [0, 0, 0], rotation=[UPRIGHT * about_up(90)], symmetry=[0])
    assert accuracy(prediction, objects([BIN], [0, 0, 0])) == 0


def test_thresholds_hold_together_and_can_be_set():
    target = objects([CHAIR], [0, 0, 0])
    assert accuracy(objects([CHAIR], [0, 0, 0.2]), target) == 1  # exactly on the limit
    assert accuracy(objects([CHAIR], [0, 0, 0.21]), target) == 0
    assert accuracy(objects([CHAIR], [0, 0, 0.21]), target, max_translation=0.25) == 1
    assert accuracy(objects([CHAIR], [0, 0, 0], size=[[1.2, 1.2, 1.2]]), target) == 1
    assert accuracy(objects([CHAIR], [0, 0, 0], size=[[1.21, 1.21, 1.21]]), target) == 0
    assert accuracy(objects([CHAIR], [0, 0, 0], size=[[0.5, 1.0, 1.5]]), target) == 1  # the mean ratio is 1
    assert (
        accuracy(objects([CHAIR], [0, 0, 0], rotation=[UPRIGHT * about_up(15)]), target, max_rotation=10.0)
        == 0
    )
    assert accuracy(objects([TABLE], [0, 0, 0]), target) == 0


def test_score_order_decides_first_fit():
    # The first prediction fits both objects and takes the first; the second fits only the first.
    target = objects([CHAIR, CHAIR], [[0, 0, 0], [0.3, 0, 0]])
    both, first = [0.15, 0, 0], [-0.1, 0, 0]
    assert accuracy(objects([CHAIR, CHAIR], [both, first], score=[0.9, 0.8]), target) == 0.5
    assert accuracy(objects([CHAIR, CHAIR], [both, first], score=[0.8, 0.9]), target) == 1.0
    assert accuracy(objects([CHAIR, CHAIR], [both, first], score=[0.8, 0.8]), target) == 0.5  # slot order
    assert accuracy(objects([CHAIR, CHAIR], [both, first], score=[np.nan, 0.1]), target) == 1.0


def test_every_scene_counts_and_a_repeated_one_counts_once():
    target = objects([CHAIR], [0, 0, 0])
    metric = Scan2CADAccuracy()
    metric.update([target, ObjectSet.empty()], [target, target], ["a", "b"])
    metric.update([ObjectSet.empty(), target], [ObjectSet.empty(), target], ["no objects", "a"])
    result = metric.compute()
    assert (result["n_good"], result["n_total"], result["n_scenes"]) == (1, 2, 3)
    assert result["class_average"] == 0.5


def test_nothing_given():
    metric = Scan2CADAccuracy()
    metric.update([], [], [])
    result = metric.compute()
    assert result["global_average"] == result["class_average"] == 0.0
    assert metric.rows() == []


def test_rows():
    target = objects(
        [CHAIR, CHAIR, TABLE, BIN], [[0, 0, 0], [2, 0, 0], [4, 0, 0], [6, 0, 0]], symmetry=[1, 1, 1, 0]
    )
    prediction = objects(
        [CHAIR, CHAIR, BIN],
        [[0.1, 0, 0], [2.5, 0, 0], [6, 0, 0.3]],
        rotation=[UPRIGHT, UPRIGHT * about_up(30), UPRIGHT * about_up(30)],
        size=[[1.1, 1.1, 1.1], [1, 1, 1], [1, 1, 1]],
        score=[0.5, 0.9, 0.7],
    )
    metric = Scan2CADAccuracy()
    metric.update([prediction], [target], ["scene"])
    chair, far, table, bin_ = metric.rows()
    assert (chair["matched"], chair["score"], chair["category"], chair["object"]) == (True, 0.5, "chair", 0)
    assert chair["translation_error_m"] == pytest.approx(0.1)
    assert chair["scale_error"] == pytest.approx(0.1)
    assert (far["matched"], far["score"]) == (False, 0.9)
    assert far["translation_error_m"] == pytest.approx(0.5)
    assert far["rotation_error_deg"] == pytest.approx(30)
    assert table["translation_error_m"] is table["score"] is None
    assert bin_["rotation_error_deg"] == pytest.approx(0, abs=1e-9)
    assert metric.rows("scene") == [
        {"scene_id": "scene", "n_good": 1, "n_total": 4, "n_predicted": 3, "accuracy": 0.25}
    ]


def test_bad_numbers_match_nothing():
    target = objects([CHAIR], [0, 0, 0])
    for part in ("center", "size", "rotation"):
        bad = replace(target, **{part: getattr(target, part) * np.nan})
        assert accuracy(bad, target) == 0
        assert accuracy(target, bad) == 0


def test_own_classes():
    """Two classes of one's own, and the objects of others refused."""
    classes = Classes(("drill", "lathe"))
    boxes = ObjectSet(
        label=torch.tensor([0, 1, 1]),
        center=torch.tensor([[0.0, 0, 0], [2, 0, 0], [4, 0, 0]]),
        size=torch.ones(3, 3),
        rotation=torch.eye(3).repeat(3, 1, 1),
        symmetry=torch.ones(3, dtype=torch.int64),
        score=torch.ones(3),
        classes=classes,
    )
    predicted = boxes.select(torch.tensor([1, 0]))
    results = {}
    for metric in (Scan2CADAccuracy, OrientedBoxF1, AccuracyCurves, ErrorAtlas):
        results[metric] = metric(classes=classes.settings())
        results[metric].update([predicted], [boxes], ["a"])
        with pytest.raises(DataError, match="objects are of 2 classes with 'drill' and without 'bathtub'"):
            metric().update([predicted], [boxes], ["a"])
    accuracy = results[Scan2CADAccuracy].compute()
    assert {name: entry["accuracy"] for name, entry in accuracy["per_class"].items()} == {
        "drill": 1.0,
        "lathe": 0.5,
    }
    assert accuracy["class_average"] == pytest.approx(0.75)
    assert set(results[OrientedBoxF1].compute()["per_threshold"]["0.5"]["per_class"]) == {"drill", "lathe"}
    assert results[AccuracyCurves].compute()["joint"]["class_average"][9] == pytest.approx(0.75)
    assert results[ErrorAtlas].compute()["per_class"]["lathe"]["missed"] == 1
    for metric, protocols in ((Scan2CADAccuracy, ("scan2cad", "vid2cad")), (OrientedBoxF1, ("odam",))):
        for protocol in protocols:
            with pytest.raises(
                ConfigError, match=f"protocol {protocol} is defined on Scan2CAD's nine classes"
            ):
                metric(protocol=protocol, classes=classes)


def test_errors():
    with pytest.raises(ConfigError, match="strict"):
        Scan2CADAccuracy(protocol="loose")
    with pytest.raises(ShapeError, match="same scenes"):
        Scan2CADAccuracy().update([ObjectSet.empty()], [], ["a"])
