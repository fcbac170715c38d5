# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64

import pytest
from jinja2 import DictLoader, UndefinedError

from raytran.pictures import page


@pytest.fixture
def templates(monkeypatch):
    """Templates of the test's own in place of the package's."""
    texts = {"a.j2": "<b>{{ name }}</b>{{ size | twice }}"}
    monkeypatch.setattr(page, "PackageLoader", lambda *_: DictLoader(texts))


def test_a_page_is_filled_and_its_text_cannot_become_markup(templates, tmp_path):
    path = tmp_path / "new" / "page.html"
    filters = {"twice": lambda value: str(2 * value)}
    assert page.write_page(path, "a.j2", filters=filters, name="<script>", size=3) == path
    assert path.read_text() == "<b>&lt;script&gt;</b>6"


def test_a_page_that_cannot_be_filled_leaves_the_one_before(templates, tmp_path):
    path = tmp_path / "page.html"
    path.write_text("before")
    with pytest.raises(UndefinedError):
        page.write_page(path, "a.j2", filters={"twice": str}, size=3)
    assert [file.name for file in tmp_path.iterdir()] == ["page.html"]
    assert path.read_text() == "before"


def test_a_picture_is_inside_its_address():
    head, content = page.data_uri(b"\x00\xff", "image/png").split(",")
    assert head == "data:image/png;base64"
    assert base64.b64decode(content) == b"\x00\xff"
