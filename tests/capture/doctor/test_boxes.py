# SPDX-License-Identifier: Apache-2.0
"""Sizes and stance of annotated boxes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.capture.doctor.boxes import check_boxes, turned
from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import ObjectSet


@pytest.fixture
def objects():
    count = 5
    return replace(
        ObjectSet.empty(),
        label=torch.zeros(count, dtype=torch.int64),
        center=torch.arange(15.0).reshape(5, 3),
        size=torch.full((count, 3), 0.8),
        rotation=rotation_from_yaw(torch.linspace(0, 3, count)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
    )


def test_furniture_is_right(objects):
    same, findings = check_boxes(objects)
    assert same is objects
    assert [finding.state for finding in findings] == ["ok", "ok"]


@pytest.mark.parametrize(("name", "factor"), [("centimetres", 100), ("millimetres", 1000)])
def test_units_of_the_annotation_are_named_and_mended(objects, name, factor):
    large = replace(objects, center=objects.center * factor, size=objects.size * factor)
    mended, findings = check_boxes(large)
    assert findings[0].cause == f"annotation in {name}"
    torch.testing.assert_close(mended.center, objects.center)
    torch.testing.assert_close(mended.size, objects.size)


def test_boxes_that_lie_down_are_named_but_one_that_leans_is_not(objects):
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    lying = turned(objects, quarter)
    torch.testing.assert_close(lying.center[1], torch.tensor([3.0, -5.0, 4.0]))
    finding = check_boxes(lying)[1][1]
    assert finding.cause == "objects lie down"
    assert "90.0°" in finding.text
    one = objects.rotation.clone()
    one[0] = lying.rotation[0]
    finding = check_boxes(replace(objects, rotation=one))[1][1]
    assert finding.state == "ok"
    assert math.isclose(float(finding.text.split("at most by ")[1].rstrip("°")), 90, abs_tol=0.1)
