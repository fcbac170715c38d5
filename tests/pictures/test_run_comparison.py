# SPDX-License-Identifier: Apache-2.0
"""The page of several runs stands alone and says what differs."""

from __future__ import annotations

import base64
import math
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest

from raytran.pictures.run_comparison import RunRecord, write_run_comparison


class Page(HTMLParser):
    """Collects images by their text, table rows, and everything said; checks that tags close in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.images: dict[str, str] = {}
        self.rows: list[list[str]] = []
        self.best: list[str] = []
        self.text, self.outside = "", []
        self._open: list[tuple[str, dict]] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        if tag == "img":
            self.images[values["alt"]] = values["src"]
        self.outside += [values[name] for name in ("src", "href") if name in values and tag != "img"]
        if tag not in ("meta", "img", "br"):
            self._open.append((tag, values))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self._open.pop()[0] == tag

    def handle_data(self, data):
        tags = [tag for tag, _ in self._open]
        if "style" in tags:
            return
        self.text += data
        if "td" in tags or "th" in tags:
            self.rows[-1][-1] += data.strip()
            if self._open and "best" in (self._open[-1][1].get("class") or ""):
                self.best.append(data)

    def row(self, name: str) -> list[str]:
        return next(row for row in self.rows if row[0] == name)


def run(name: str, iou: float, rate: float, **history) -> RunRecord:
    logged = {
        "train/total": [(step, 5.0 / (step + 1) + rate) for step in range(200)],
        "train/objects/class/layer0": [(0, 1.0)],
        "val/occupancy/iou": [(99, iou / 2), (199, iou)],
        "val/objects/accuracy/chair": [(199, iou)],
        "val/total": [(199, 1 - iou)],
    }
    settings = {"optimizer.learning_rate": rate, "seed": 0}
    return RunRecord(name, logged | history, settings, {"stage": "stage2", "steps": "200"})


@pytest.fixture
def page(tmp_path):
    runs = [run("a <b>", 0.25, 1e-3), run("c", 0.5, 3e-3)]
    return Page(write_run_comparison(tmp_path / "report.html", runs, notes=["d is left out."]).read_text())


def test_the_page_stands_alone(page, tmp_path):
    assert page.outside == []
    assert all(source.startswith("data:image/svg+xml;base64,") for source in page.images.values())
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_numbers_and_settings_side_by_side(page):
    assert page.row("occupancy/iou") == ["occupancy/iou", "0.250", "0.500"]
    assert page.row("objects/accuracy/chair") == ["objects/accuracy/chair", "0.250", "0.500"]
    assert page.row("optimizer.learning_rate") == ["optimizer.learning_rate", "0.001", "0.003"]
    assert "1 more are the same" in page.text
    assert not any(row[0] == "seed" for row in page.rows)
    assert page.best == ["0.500", "0.500", "0.500"], "two scores and the loss of c are the better ones"
    assert page.row("a <b>") == ["a <b>", "stage2", "200"]
    assert "d is left out." in page.text


def lines(source: str) -> list[list[float]]:
    """Return the heights of the curves in a chart, in the picture's pixels."""
    tree = ElementTree.fromstring(base64.b64decode(source.split(",")[1]))
    paths = [
        path.get("d")
        for path in tree.iter("{http://www.w3.org/2000/svg}path")
        if "clip-path" in path.attrib and "stroke-width: 1.6" in path.get("style", "")
    ]
    return [[float(y) for _, y in re.findall(r"[ML] (\S+) (\S+)", path)] for path in paths]


def test_curves_lie_over_each_other(page):
    assert set(page.images) == {
        f"{name} against steps" for name in ("train/total", "val/occupancy/iou", "val/total")
    }
    first, second = lines(page.images["train/total against steps"])
    assert first[0] < first[-1], "a falling loss ends lower, which is a larger height in a picture"
    assert all(a > b for a, b in zip(first, second, strict=True)), "the second run has the higher loss"
    rising, _ = lines(page.images["val/occupancy/iou against steps"])
    assert rising[0] > rising[-1]


def test_values_that_are_not_finite_are_no_winners(tmp_path):
    lost = run("lost", math.nan, 1e-3, **{"train/total": [(0, math.nan), (1, math.inf)]})
    page = Page(write_run_comparison(tmp_path / "report.html", [lost, run("good", 0.5, 1e-3)]).read_text())
    assert page.row("occupancy/iou") == ["occupancy/iou", "nan", "0.500"]
    assert page.best == []
    assert len(lines(page.images["train/total against steps"])) == 1


def test_a_run_by_itself_is_compared_with_nothing(tmp_path):
    page = Page(write_run_comparison(tmp_path / "report.html", [run("a", 0.5, 1e-3)]).read_text())
    assert page.best == []
    assert "Settings that differ" not in page.text
