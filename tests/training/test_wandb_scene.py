# SPDX-License-Identifier: Apache-2.0
"""What Weights & Biases is given of a scene: names and colours of whatever classes there are."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from raytran.classes import Classes
from raytran.structs import ObjectSet, SceneBatch, ScenePrediction, Views

wandb = pytest.importorskip("wandb")
from raytran.training.wandb_scene import object_table, scene_in_3d  # noqa: E402 - after the check

CLASSES = Classes(("drill", "lathe", "bench"), colors=((0, 51, 255), (1, 2, 3), (4, 5, 6)))


def test_boxes_and_rows_have_the_names_of_own_classes(monkeypatch):
    found = ObjectSet(
        label=torch.tensor([0]),
        center=torch.zeros(1, 3),
        size=torch.ones(1, 3),
        rotation=torch.eye(3)[None],
        symmetry=torch.ones(1, dtype=torch.int64),
        score=torch.tensor([0.5]),
        classes=CLASSES,
    )
    truth = replace(found, label=torch.tensor([2]), score=torch.ones(1))
    views = Views(torch.zeros(1, 1, 3, 4, 4), torch.eye(3)[None, None], torch.eye(4)[None, None])
    batch = SceneBatch(("room",), views, (("0",),), torch.zeros(1, 3), (truth,))
    prediction = ScenePrediction("room", found, torch.zeros(3))
    monkeypatch.setattr(wandb, "Object3D", lambda content: content)
    boxes = scene_in_3d(batch, prediction, (1.0, 1.0, 1.0))["boxes"]
    assert [box["label"] for box in boxes] == ["true bench", "drill 0.50"]
    assert boxes[1]["color"] == [0.0, 0.2, 1.0]
    rows = object_table([(batch, prediction)]).data
    assert [(row[1], row[2]) for row in rows] == [("predicted", "drill"), ("true", "bench")]
