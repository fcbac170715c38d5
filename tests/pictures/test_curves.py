# SPDX-License-Identifier: Apache-2.0
"""Loss curves, one plot a stage."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from raytran.pictures.curves import draw_curves

FALLING = {"train/total": [(step, 4.0 / (step + 1)) for step in range(40)], "val/total": [(39, 1.0)]}


def ink(path) -> np.ndarray:
    """Rows and columns of the dark pixels inside the plot of a single stage, legend and axes cut away."""
    image = np.asarray(Image.open(path).convert("L"))
    height, width = image.shape
    inner = image[int(0.25 * height) : int(0.8 * height), int(0.2 * width) : int(0.95 * width)]
    return np.argwhere(inner < 90)


def test_a_falling_loss_falls_to_the_right(tmp_path):
    rows, columns = ink(draw_curves(tmp_path / "one.png", {"occupancy": FALLING})).T
    assert np.corrcoef(rows, columns)[0, 1] > 0.8


def test_one_plot_a_stage(tmp_path):
    one = Image.open(draw_curves(tmp_path / "one.png", {"occupancy": FALLING}))
    stages = {"occupancy": FALLING, "joint": FALLING, "shape": {}}
    three = Image.open(draw_curves(tmp_path / "three.png", stages))
    assert three.width == pytest.approx(3 * one.width, abs=3)


def test_earlier_decoder_layers_and_validation_are_left_out(tmp_path):
    more = FALLING | {"train/objects/class/layer0": [(step, 900.0) for step in range(40)]}
    same = [
        draw_curves(tmp_path / f"{n}.png", {"joint": h}).read_bytes() for n, h in enumerate([FALLING, more])
    ]
    assert same[0] == same[1]
