# SPDX-License-Identifier: Apache-2.0
"""``raytran prepare dataset=rooms-v1`` at its end: what the rooms are like."""

from __future__ import annotations

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from raytran.rooms import benchmark
from raytran.rooms import report as rooms_report
from raytran.rooms.report import draw_rooms, rooms_text
from raytran.run.entry import compose
from raytran.run.prepare.prepare import prepare


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a small benchmark made by the command, and what the command said."""
    root = tmp_path_factory.mktemp("rooms-v1")
    said = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())
    logger = logging.getLogger("raytran.run.prepare.prepare")
    with pytest.MonkeyPatch.context() as patch:
        small = replace(benchmark.SETTINGS, frames=4, image_size=(48, 64), max_objects=6)
        patch.setattr(benchmark, "SETTINGS", small)
        patch.setattr(logger, "level", logging.INFO)
        logger.addHandler(handler)
        numbers = ["num_train=2", "num_val=1", "num_test=0", "processes=1"]
        prepare(compose("prepare", ["dataset=rooms-v1", f"output={root}", *numbers]))
        logger.removeHandler(handler)
    return root, "\n".join(said)


def test_the_report_is_said_and_written(made):
    root, said = made
    report = json.loads((root / "report.json").read_text())
    text = (root / "report.txt").read_text()
    assert text in said
    assert f"data=rooms-v1 data.root={root}" in said
    rows = {line[:35].strip(): line[35:].split() for line in text.splitlines() if line.strip()}
    assert rows["rooms"] == ["2", "1"]
    assert rows["objects"] == [str(report[split]["objects"]) for split in ("train", "val")]
    chairs = [report[split]["by_class"]["chair"]["objects"] for split in ("train", "val")]
    counted = next(line.split() for line in text.splitlines() if line.split()[:1] == ["chair"])
    assert counted == ["chair", *map(str, chairs), "1093"]  # the paper's validation scans beside them


def test_the_sheet_shows_rooms_of_each_split_plain_and_drawn_over(made, tmp_path, monkeypatch):
    root, _ = made
    sheet = np.asarray(Image.open(root / "rooms.jpg").convert("RGB")).astype(int)
    rows = np.array_split(sheet, 4)  # train, train drawn over, val, val drawn over
    tile = sheet.shape[1] // 5
    for plain, drawn, rooms in ((rows[0], rows[1], 2), (rows[2], rows[3], 1)):
        height = min(len(plain), len(drawn)) - 8
        for n in range(5):
            a, b = (row[4:height, n * tile + 4 : (n + 1) * tile - 4] for row in (plain, drawn))
            assert (a.min() < 200) == (n < rooms)
            # Class colours are strong; rooms are pale.
            assert (np.abs(a - b).mean() > 5) == (n < rooms)
    monkeypatch.setattr(rooms_report, "_ROOMS_SHOWN", 1)
    assert draw_rooms(tmp_path / "one.jpg", root) == tmp_path / "one.jpg"
    assert [path.name for path in tmp_path.iterdir()] == ["one.jpg"]


def test_a_class_without_objects_has_no_size(made):
    report = json.loads((made[0] / "report.json").read_text())
    for part in report.values():
        part["by_class"]["bathtub"] = {"objects": 0, "size_m": None}
    sizes = rooms_text(report).split("Median")[1]
    assert "bathtub" in sizes
    assert sizes.count("none") >= 2
