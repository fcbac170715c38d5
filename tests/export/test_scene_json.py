# SPDX-License-Identifier: Apache-2.0
"""How sure one may be of an object, for how many views saw it."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from raytran.export import read_scene_json, write_scene_json


def test_few_views_lower_the_confidence_and_not_the_score(tmp_path, prediction):
    objects = replace(
        prediction.objects, score=torch.tensor([0.9, 0.8]), num_views=torch.tensor([1.0, 19.04])
    )
    path = write_scene_json(tmp_path / "scene.json", replace(prediction, objects=objects), [None, None])
    few, many = json.loads(path.read_text())["objects"]
    assert (few["num_views"], many["num_views"]) == (1.0, 19.0)
    assert (few["score"], many["score"]) == pytest.approx((0.9, 0.8))
    assert few["confidence"] == pytest.approx(0.45)
    assert many["confidence"] == pytest.approx(0.8 * 19.04 / 20.04)
    assert read_scene_json(path).objects.score.tolist() == pytest.approx([0.9, 0.8])


def test_without_counted_views_nothing_is_said_of_them(tmp_path, prediction):
    path = write_scene_json(tmp_path / "scene.json", prediction, [None, None])
    assert not {"num_views", "confidence"} & set(json.loads(path.read_text())["objects"][0])
