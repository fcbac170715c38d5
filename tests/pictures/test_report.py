# SPDX-License-Identifier: Apache-2.0
"""The page stands alone, says everything, and escapes what it is given."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser

from PIL import Image

from raytran.pictures.report import Picture, Report, Section, SplitScores, write_report


class Page(HTMLParser):
    """Collects sources, links, and the text of a page, and checks that tags close in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.sources += [values["src"]] if "src" in values else []
        self.links += [values["href"]] if "href" in values else []
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += f" {data} " if not self.open or self.open[-1] != "style" else ""


def report(folder) -> Report:
    Image.new("RGB", (4, 4), (200, 0, 0)).save(folder / "plan.png")
    return Report(
        title="Rooms <&> numbers",
        summary="Four rooms.",
        splits=[
            SplitScores("Training rooms", "The chain learns.", {"accuracy": "95 %"}, {"chair": (3, 4)}),
            SplitScores(
                "Held-out rooms", "Proves nothing.", {"accuracy": "5 %"}, {"sofa": (0, 2), "chair": (1, 5)}
            ),
        ],
        sections=[
            Section("A held-out room", "From above.", [Picture(folder / "plan.png", "plan", wide=True)])
        ],
        steps={"rooms": 9.96, "training": 125.0},
        files={"meshes": folder / "predictions" / "meshes"},
        versions={"torch": "2.13.0"},
    )


def test_the_page_stands_alone(tmp_path):
    page = Page(write_report(tmp_path / "index.html", report(tmp_path)).read_text())
    assert page.open == []
    (source,) = page.sources
    assert (
        base64.b64decode(source.removeprefix("data:image/png;base64,"))
        == (tmp_path / "plan.png").read_bytes()
    )
    assert page.links == ["predictions/meshes"]
    assert [path.name for path in tmp_path.iterdir() if path.name.endswith(".part")] == []


def test_the_page_says_everything(tmp_path):
    text = Page(write_report(tmp_path / "index.html", report(tmp_path)).read_text()).text
    flat = re.sub(r"\s+", " ", text)
    for words in (
        "Rooms <&> numbers",
        "95 %",
        "The chain learns.",
        "3 of 4",
        "0 of 2",
        "1 of 5",
        "none here",
        "2.13.0",
    ):
        assert words in flat
    assert "rooms 10.0 s" in flat
    assert "training 2 min 05 s" in flat
    assert "all 2 min 15 s" in flat
    assert "bathtub" not in flat, "a class that occurs nowhere has no row"
    assert flat.index("chair") < flat.index("sofa")
