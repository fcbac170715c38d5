# SPDX-License-Identifier: Apache-2.0
"""The paper's figure 4: lines are the numbers of the metric, on the axes that they say."""

from __future__ import annotations

import pytest
import torch
from PIL import Image

from raytran.geometry.rotation import rotation_from_yaw
from raytran.metrics.accuracy_curves import AccuracyCurves
from raytran.pictures.accuracy_curves import accuracy_figure, draw_accuracy_curves
from raytran.structs import ObjectSet


def objects(shift=0.0, yaw=0.0, ratio=1.0) -> ObjectSet:
    """A chair and two tables."""
    return ObjectSet(
        label=torch.tensor([3, 6, 6]),
        center=torch.tensor([[0.0, 0, 0], [3.0, 0, 0], [6.0, 0, 0]]) + torch.tensor([shift, 0.0, 0.0]),
        size=torch.ones(3, 3) * ratio,
        rotation=rotation_from_yaw(torch.full((3,), yaw)),
        symmetry=torch.ones(3, dtype=torch.int64),
        score=torch.ones(3),
    )


def curves(found: ObjectSet):
    metric = AccuracyCurves()
    metric.update([found], [objects()], ["a"])
    return metric.compute()


def lines(axes):
    """Lines by label; the dotted limit and the dots have none of their own."""
    return {line.get_label(): line.get_xydata() for line in axes.get_lines() if line.get_label()[0] != "_"}


def test_lines_are_the_curves():
    """Chair and one table are 11 cm, 0.2 rad and 31 % off, the other table is not found at all."""
    result = curves(objects(0.11, 0.2, 1.31).select(torch.tensor([0, 1])))
    plots = accuracy_figure({"mine": result}).get_axes()
    assert [axes.get_xlabel().split(",")[0] for axes in plots[:3]] == [
        "translation error below",
        "rotation error below",
        "scale error below",
    ]
    # A line rises at the first sampled threshold that is not below the error: 12 cm, 12 degrees, 32 %.
    for axes, first in zip(plots[:3], (12.0, 12.0, 32.0), strict=True):
        found = lines(axes)
        for label, height in (("mean of classes", 0.75), ("all objects", 2 / 3)):
            threshold, accuracy = found[label].T
            assert threshold[0] == pytest.approx(2)
            assert threshold[-1] == pytest.approx(60)
            assert accuracy == pytest.approx([height if t >= first - 1e-6 else 0.0 for t in threshold])
        (dot,) = [line for line in axes.get_lines() if line.get_marker() == "o"]
        assert dot.get_xydata().tolist() == [[20.0, 0.75 if first <= 20 else 0.0]]
        assert axes.get_lines()[0].get_xdata() == [20.0, 20.0]
    threshold, accuracy = lines(plots[3])["mean of classes"].T
    assert accuracy == pytest.approx([0.75 if t >= 1.6 - 1e-6 else 0.0 for t in threshold])


def test_several_results_have_a_line_each_and_no_other():
    results = {"a": curves(objects()), "b": curves(objects(0.3)), "c": curves(objects(0.0, 1.0))}
    figure = accuracy_figure(results)
    for axes, curve in zip(figure.get_axes(), ("translation", "rotation", "scale", "joint"), strict=True):
        found = lines(axes)
        assert list(found) == ["a", "b", "c"]
        for name, line in found.items():
            assert line[:, 1].tolist() == results[name][curve]["class_average"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b", "c"]
    assert figure.get_axes()[0].get_ylabel() == "accuracy, mean of classes"


def test_many_results_can_be_told_apart():
    figure = accuracy_figure({str(index): curves(objects()) for index in range(9)})
    looks = {
        (line.get_color(), line.get_linestyle())
        for line in figure.get_axes()[0].get_lines()
        if line.get_label()[0] != "_"
    }
    assert len(looks) == 9


@pytest.mark.parametrize("found", [ObjectSet.empty(), objects(0.5)])
def test_a_picture_is_written_even_if_nothing_was_found(found, tmp_path):
    with Image.open(draw_accuracy_curves(tmp_path / "x.png", {"mine": curves(found)})) as picture:
        assert picture.size == (1584, 480)
