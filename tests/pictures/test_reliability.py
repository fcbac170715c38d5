# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch
from PIL import Image

from raytran.metrics.functional.calibration import reliability
from raytran.pictures.reliability import draw_reliability, reliability_figure


def test_bars_are_the_shares_of_right_boxes(tmp_path):
    score = torch.tensor([0.62, 0.68, 0.91, 0.95, 0.99])
    found = reliability(score, torch.tensor([True, False, True, True, False]))
    (axes,) = reliability_figure(found).axes
    bars = {round(bar.get_x() + bar.get_width() / 2, 6): bar.get_height() for bar in axes.patches}
    assert bars == {0.65: 0.5, 0.95: pytest.approx(2 / 3)}
    assert [text.get_text() for text in axes.texts] == ["2", "3"]
    assert axes.get_title() == f"expected calibration error {found['expected_error']:.3f}"
    with Image.open(draw_reliability(tmp_path / "a.png", found)) as picture:
        assert picture.width > 300


def test_no_prediction_is_said():
    (axes,) = reliability_figure(reliability(torch.zeros(0), torch.zeros(0, dtype=torch.bool))).axes
    assert (axes.get_title(), list(axes.patches)) == ("no prediction", [])
