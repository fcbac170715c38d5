# SPDX-License-Identifier: Apache-2.0
"""The picture for the README."""

from __future__ import annotations

import importlib.util

import pytest
from PIL import Image


@pytest.fixture(scope="module")
def script(project_root):
    spec = importlib.util.spec_from_file_location("docs_picture", project_root / "docs" / "picture.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("count", [0, 1, 4, 5])
def test_frames_and_plan_are_side_by_side(script, tmp_path, count):
    (tmp_path / "overlays").mkdir()
    for number in range(count):
        Image.new("RGB", (320, 240), (255, 0, 0)).save(tmp_path / "overlays" / f"{number}.jpg")
    Image.new("RGB", (500, 400), (0, 0, 255)).save(tmp_path / "topdown.png")
    sheet = script.picture(tmp_path)
    assert sheet.height == script.HEIGHT
    colors = [sheet.getpixel((x, 300)) for x in range(sheet.width)]
    red, blue = (sum(pixel[channel] > 200 > pixel[2 - channel] for pixel in colors) for channel in (0, 2))
    assert blue == 800
    columns = {0: 0, 1: 1, 4: 2, 5: 3}[count]
    assert red == pytest.approx(columns * (853 if count == 1 else 423), abs=6)
