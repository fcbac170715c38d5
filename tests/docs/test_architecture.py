# SPDX-License-Identifier: Apache-2.0
"""docs/architecture.md: its picture has the folders of the layers, its lines name what is there."""

from __future__ import annotations

import importlib.util
import json
import re

import pytest
from PIL import Image

from ..test_layers import LAYERS, WINGS


@pytest.fixture(scope="module")
def script(project_root):
    spec = importlib.util.spec_from_file_location("architecture", project_root / "docs" / "architecture.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_picture_has_the_layers(script):
    layers = [layer - {"__main__"} for layer in LAYERS]  # the commands stand for what calls them by name
    assert [set(column) for column in script.COLUMNS] == [layer for layer in layers if layer != WINGS]
    assert set(script.WINGS) == WINGS
    drawn = {text.get_text() for text in script.draw().axes[0].texts}
    assert set.union(*layers) <= drawn


def test_the_picture_is_of_this_script(script):
    with Image.open(script.PICTURE) as picture:
        said = json.loads(picture.text["Description"])
    assert said == script.content(), "run python docs/architecture.py"


def test_every_line_names_what_is_there(project_root):
    page = project_root / "docs" / "architecture.md"
    text = page.read_text(encoding="utf-8")
    for heading in ("The way of a batch", "The way of a prediction"):
        lines = re.findall(r"^\d+\. (.+)$", text.split(f"## {heading}")[1].split("##")[0], re.MULTILINE)
        assert len(lines) == 10
        for line in lines:
            assert re.search(r"\]\(\.\./src/raytran/", line)
    for name, path in re.findall(r"\[`([\w.]+)`\]\((\.\./src/[^)]+\.py)\)", text):
        if name.endswith(".py"):
            continue
        source = (page.parent / path).read_text(encoding="utf-8")
        last = name.split(".")[-1]
        defined = rf"^\s*(?:class|def) {last}\b|^{last}\b.*="
        assert re.search(defined, source, re.MULTILINE), f"{path} has no {name}"
