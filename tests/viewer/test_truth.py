# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math

import pytest
import torch

from raytran.errors import DataError
from raytran.geometry.rotation import rotation_from_yaw
from raytran.metrics import Scan2CADAccuracy
from raytran.structs import ObjectSet
from raytran.viewer.truth import object_errors, read_truth


def objects(*rows, dtype=torch.float32, symmetry=1):
    """Make upright objects of rows (label, x, yaw in degrees, width, score)."""
    label, x, yaw, width, score = torch.tensor(rows, dtype=torch.float64).reshape(-1, 5).unbind(1)
    zero = torch.zeros_like(x)
    return ObjectSet(
        label=label.long(),
        center=torch.stack([x, zero, zero], dim=1).to(dtype),
        size=torch.stack([width, zero + 1, zero + 1], dim=1).to(dtype),
        rotation=rotation_from_yaw(torch.deg2rad(yaw)).to(dtype),
        symmetry=torch.full_like(label, symmetry, dtype=torch.int64),
        score=score.to(dtype),
    )


def test_the_surer_prediction_finds_and_the_other_is_only_compared():
    truth = objects(
        (3, 0.0, 0.0, 1.0, 1.0), (3, 5.0, 0.0, 1.0, 1.0), (6, 9.0, 0.0, 1.0, 1.0), dtype=torch.float64
    )
    found = object_errors(
        objects(
            (3, 0.1, 0.0, 1.0, 0.6),
            (3, 0.0, 10.0, 1.3, 0.9),
            (6, 8.0, 0.0, 1.0, 0.5),
            (0, 0.0, 0.0, 1.0, 0.4),
        ),
        truth,
    )
    assert [entry and entry.found for entry in found] == [False, True, False, None]
    assert [entry and entry.truth for entry in found] == [0, 0, 2, None]
    assert found[1].rotation == pytest.approx(10.0, abs=1e-3)
    assert found[1].scale == pytest.approx(0.1, abs=1e-6)
    assert found[0].translation == pytest.approx(0.1, abs=1e-6)
    assert found[0].iou == pytest.approx(0.9 / 1.1, abs=1e-6)
    assert found[2].iou == 0.0


def test_it_counts_as_the_strict_metric_does(generator):
    def random(count):
        columns = [
            torch.randint(0, 3, (count,), generator=generator),
            torch.randint(0, 4, (count,), generator=generator)
            + 0.15 * torch.randn(count, generator=generator),
            15 * torch.randn(count, generator=generator),
            1 + 0.1 * torch.randn(count, generator=generator).abs(),
            torch.rand(count, generator=generator),
        ]
        return objects(*torch.stack([column.double() for column in columns], dim=1).tolist())

    predictions, truth = random(20), random(20)
    metric = Scan2CADAccuracy(protocol="strict")
    metric.update([predictions], [truth], ["a"])
    entries = [entry for entry in object_errors(predictions, truth) if entry and entry.found]
    assert 0 < len(entries) == metric.compute()["n_good"]
    assert len({entry.truth for entry in entries}) == len(entries)


def test_symmetry_and_no_truth():
    half_turn = object_errors(objects((3, 0, 180, 1, 1)), objects((3, 0, 0, 1, 1), symmetry=2))
    assert half_turn[0].rotation == pytest.approx(0.0, abs=math.degrees(1e-3))
    assert object_errors(objects((3, 0, 0, 1, 1)), ObjectSet.empty()) == [None]
    assert object_errors(ObjectSet.empty(), objects((3, 0, 0, 1, 1))) == []


def test_truth_in_two_forms(tmp_path):
    annotations = tmp_path / "full_annotations.json"
    upright = {"translation": [3, 0, 1], "rotation": [0.5**0.5, 0.5**0.5, 0, 0], "scale": [1, 2, 3]}
    model = {"catid_cad": "03001627", "id_cad": "a", "trs": upright, "bbox": [0.5] * 3, "center": [0.0] * 3}
    still = {"translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "scale": [1, 1, 1]}
    entry = {"id_scan": "room", "trs": still, "aligned_models": [model | {"sym": "__SYM_NONE"}]}
    annotations.write_text(json.dumps([entry]))
    torch.testing.assert_close(read_truth(annotations, "room").center, torch.tensor([[3.0, 0.0, 1.0]]))
    with pytest.raises(DataError, match="has no scene hall: give the annotations of this scene as truth="):
        read_truth(annotations, "hall")
    entry = {"category": "chair", "score": 1.0, "center": [1, 2, 3], "size": [1, 1, 1], "mesh": None}
    entry["rotation"] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps({"format": "raytran.scene/1", "scene_id": "any", "objects": [entry]}))
    assert read_truth(scene, "room").center.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("content", [None, "no json", "[{}]", '{"format": "raytran.scene/1"}', '{"a": 1}'])
def test_no_truth_there(tmp_path, content):
    path = tmp_path / "truth.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=r"truth\.json"):
        read_truth(path, "room")
