# SPDX-License-Identifier: Apache-2.0
"""The page ``docs/your-classes.md`` from its first command to its last, on generated rooms."""

from __future__ import annotations

import json
import re
import shlex

import pytest

from raytran.checkpoints.load import load_model
from raytran.viewer.data import find_scenes, read_viewer_scene

from ..capture.boxes.forms import listed, room_scan, write_capture

CLASSES = ("bench", "drill", "lathe")
NAMES = {"chair": "bench", "sofa": "bench", "table": "drill"}
CAPTURES = {"hall": "colmap", "yard": "tum", "shed": "video"}
SMALL = {
    "predict": ["num_views=4", "turntable=0", "num_overlays=1", "score_threshold=0"],
    "prepare": ["processes=1", "max_frames=6"],
    "train": [
        *("schedule.stage2.steps=2", "schedule.stage3.steps=1", "trainer=cpu", "views.num_views=2"),
        *("progress_bar=none", "watch.pictures=0", "check_parent=stage"),
    ],
    "evaluate": ["num_views=3", "num_resamples=1"],
}
"""What makes the page's commands quick."""


def commands(page):
    """Return name and words of the commands in the numbered sections of a page, in their order."""
    found = []
    for section in re.split(r"^## ", page, flags=re.MULTILINE):
        for block in re.findall(r"```bash\n(.*?)```", section, re.DOTALL) if section[0].isdigit() else ():
            words = [shlex.split(line) for line in block.splitlines()]
            found += [(line[2].removeprefix("raytran."), line[3:]) for line in words]
    return found


@pytest.mark.nightly
def test_the_page_from_a_scan_to_a_network_that_names_ones_own_classes(command, project_root, tmp_path):
    page = (project_root / "docs" / "your-classes.md").read_text(encoding="utf-8")
    rooms = {name: room_scan(number) for number, name in enumerate(CAPTURES)}
    for name, kind in CAPTURES.items():
        write_capture(rooms[name], tmp_path / "captures" / name, kind)
        (tmp_path / "captures" / name / "boxes.json").unlink()
    ran: list[str] = []
    for name, words in commands(page):
        ran.append(name)
        if "dataset=boxes" in words:
            correct(tmp_path, rooms)
        runs = sorted((tmp_path / "outputs" / "laptop" / "stage2").glob("*"))
        typed = [word.replace("outputs/laptop/stage2/…", str(runs[-1])) if runs else word for word in words]
        if name == "view":
            break
        result = command(name, *typed, *SMALL.get(name, []), folder=tmp_path)
        # None of these captures has a mesh.
        fails = "experiment=stage3" in words
        assert result.returncode == int(fails), result.stderr
        assert ("has a shape to learn, only boxes are known" in result.stderr) == fails
    assert ran == ["predict", "prepare", "prepare", "train", "train", "evaluate", "predict", "view"]
    assert load_model(runs[-1] / "checkpoints" / "last.ckpt").classes.names == CLASSES
    metrics = json.loads((tmp_path / "scores" / "metrics.json").read_text())
    assert tuple(metrics["strict"]["per_class"]) == CLASSES
    (shown,) = find_scenes(tmp_path / typed[0]).values()
    assert read_viewer_scene(shown).objects.classes.names == CLASSES


def correct(folder, rooms):
    """Write the boxes of each room as a user would: into what was predicted, or anew."""
    predicted = folder / "predictions" / "hall" / "scene.json"
    content = json.loads(predicted.read_text())
    for name, room in rooms.items():
        boxes = [box | {"category": NAMES.get(box["category"], "lathe")} for box in listed(room)]
        if name == "hall":
            predicted.write_text(json.dumps(content | {"objects": boxes}))
        else:
            (folder / "predictions" / f"{name}.json").write_text(json.dumps(boxes))
