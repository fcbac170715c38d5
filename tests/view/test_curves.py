# SPDX-License-Identifier: Apache-2.0
"""Loss curves come out of a CSV file as they were logged."""

from __future__ import annotations

import pytest
from PIL import Image

from raytran.errors import DataError
from raytran.view.curves import draw_curves, read_curves

CSV = """epoch,step,train/total,train/objects/class/layer0,val/total
0,0,4.0,1.0,
0,0,,,3.5
1,10,2.0,0.5,
1,20,1.0,0.25,1.5
"""


def test_empty_cells_are_left_out(tmp_path):
    (tmp_path / "metrics.csv").write_text(CSV)
    curves = read_curves(tmp_path / "metrics.csv")
    assert curves["train/total"] == ([0, 10, 20], [4.0, 2.0, 1.0])
    assert curves["val/total"] == ([0, 20], [3.5, 1.5])
    assert set(curves) == {"train/total", "train/objects/class/layer0", "val/total"}


def test_one_plot_a_stage(tmp_path):
    (tmp_path / "metrics.csv").write_text(CSV)
    curves = read_curves(tmp_path / "metrics.csv")
    one = draw_curves(tmp_path / "one.png", {"occupancy": curves})
    three = draw_curves(tmp_path / "three.png", {"occupancy": curves, "joint": curves, "shape": {}})
    assert Image.open(three).width == pytest.approx(3 * Image.open(one).width, abs=3)


@pytest.mark.parametrize("content", [None, "epoch,step,train/total\n0,0,many\n"])
def test_a_damaged_file_is_named(tmp_path, content):
    path = tmp_path / "metrics.csv"
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=r"cannot read loss curves from .*metrics\.csv"):
        read_curves(path)
