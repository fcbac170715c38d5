# SPDX-License-Identifier: Apache-2.0
"""The demo's page keeps training rooms and held-out rooms apart and shows what was found."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch

from raytran.classes import PAPER_CLASSES
from raytran.run.demo.page import ShownScene, headline, write_page
from raytran.run.predict.write_scene import PredictedScene, write_scene
from raytran.run.train.fit import FitResult
from raytran.structs import ObjectSet, SceneBatch, ScenePrediction, Views
from raytran.viewer import HTML

UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


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
        if tag not in ("meta", "img", "br", "wbr"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += f" {data} " if not self.open or self.open[-1] != "style" else ""


def metrics(n_good: int) -> dict:
    counts = {"n_good": 0, "n_total": 0, "accuracy": 0.0}
    per_class = {name: dict(counts) for name in PAPER_CLASSES.names}
    per_class["chair"] = {"n_good": n_good, "n_total": 5, "accuracy": n_good / 5}
    total = {
        "n_good": n_good,
        "n_total": 5,
        "n_scenes": 1,
        "global_average": n_good / 5,
        "class_average": 0.0,
    }
    thresholds = {"0.25": {"f1": 0.75}, "0.5": {"f1": 0.5}}
    return {
        "strict": {"per_class": per_class, "per_threshold": thresholds, **total},
        "occupancy_iou": 0.25,
        "num_views": 12,
    }


def scene(split: str, scene_id: str, output) -> ShownScene:
    one = torch.ones(1, dtype=torch.int64)
    center = torch.tensor([[0.0, 3.0, 0.0]])
    objects = ObjectSet(3 * one, center, torch.ones(1, 3), UPRIGHT[None], one, torch.ones(1))
    pose = torch.eye(4).repeat(3, 1, 1)
    pose[:, :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    intrinsics = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]).expand(3, 3, 3)
    views = Views(torch.zeros(1, 3, 3, 48, 64, dtype=torch.uint8), intrinsics[None], pose[None])
    batch = SceneBatch(
        scene_id=(scene_id,),
        views=views,
        frame_id=(("0", "90", "100"),),
        grid_center=torch.zeros(1, 3),
        objects=(objects,),
        occupancy=torch.zeros(1, 4, 4, 4, dtype=torch.bool),
        foreground=torch.zeros(1, 3, 48, 64, dtype=torch.bool),
    )
    prediction = ScenePrediction(
        scene_id,
        objects,
        torch.zeros(3),
        occupancy=torch.rand(4, 4, 4),
        foreground=torch.rand(3, 48, 64),
        grid_extent=(6.0, 6.0, 3.0),
    )
    folder = output / "predictions" / scene_id
    extent = (6.0, 6.0, 3.0)
    found = PredictedScene(prediction, [None])
    write_scene(folder, found, views, batch.frame_id[0], turntable=0, truth=objects)
    if split == "train":
        (folder / HTML).touch()
    return ShownScene(split, folder, batch, prediction, extent)


def test_headline():
    assert headline(metrics(4)) == {
        "accuracy": "80%",
        "objects": "4 of 5",
        "F1 at IoU 0.25": "0.75",
        "F1 at IoU 0.5": "0.50",
        "occupancy IoU": "0.25",
    }
    assert headline(metrics(4) | {"shape": {"iou": 0.6}})["shape IoU"] == "0.60"
    assert headline(metrics(0) | {"shape": {"iou": None}})["shape IoU"] == "–"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("demo")


@pytest.fixture(scope="module")
def page(folder) -> str:
    logs = folder / "training" / "stage1"
    logs.mkdir(parents=True)
    (logs / "metrics.csv").write_text("epoch,step,train/total\n0,1,2.0\n0,2,1.0\n")
    fit = FitResult(logs, logs / "checkpoints" / "last.ckpt", 2, 1.0, {})
    path = write_page(
        folder,
        scenes=[scene("train", "scene0000_00", folder), scene("val", "scene0001_00", folder)],
        metrics={"train": metrics(5), "val": metrics(1)},
        fits=[fit],
        seconds={"rooms": 9.96, "training": 125.0},
    )
    assert path == folder / "index.html"
    return re.sub(r"data:[^\"]+", "data:", path.read_text())


def test_splits_are_told_apart(page):
    training, held_out = page.index("<h3>Training rooms</h3>"), page.index("<h3>Held-out rooms</h3>")
    assert training < page.index("5 of 5") < page.index("trained on these very rooms") < held_out
    assert held_out < page.index("1 of 5") < page.index("has never seen these rooms")
    assert "A training room: scene0000_00" in page
    assert "A held-out room: scene0001_00" in page


def test_pictures_and_files_are_there(page, folder):
    assert page.count('src="data:"') == 2 * 5 + 1
    assert 'href="predictions/scene0001_00/scene.glb"' in page
    assert (folder / "predictions" / "scene0001_00" / "scene.glb").is_file()
    assert 'href="training/stage1/checkpoints/last.ckpt"' in page


def test_the_page_says_everything_and_closes_its_tags(page):
    parsed = Page(page)
    assert parsed.open == []
    flat = re.sub(r"\s+", " ", parsed.text)
    for words in ("RayTran on generated rooms", "5 of 5", "1 of 5", "torch"):
        assert words in flat
    assert "rooms 10.0 s" in flat
    assert "training 2 min 05 s" in flat
    assert "all 2 min 15 s" in flat
    assert "bathtub" not in flat, "a class that occurs nowhere has no row"
    assert set(parsed.sources) == {"data:"}, "it stands alone"


def test_one_object_is_one_and_the_frames_are_counted(page):
    flat = re.sub(r"\s+", " ", Page(page).text)
    assert "1 object was predicted, 1 is there." in flat
    assert "12 of each room" in flat


def test_a_room_can_be_looked_at_in_3d(page, folder):
    links = Page(page).links
    assert "predictions/scene0000_00/prediction.html" in links
    assert "predictions/scene0001_00/prediction.html" not in links, "no link to what is not there"
    assert not any(link.endswith(".gif") for link in links)
    assert f"raytran view {folder / 'predictions'}</code>" in page


def test_long_names_of_files_break_between_folders_alone(page):
    (files,) = re.findall(r'<dl class="card files">(.*?)</dl>', page, flags=re.DOTALL)
    assert "predictions/<wbr>scene0000_00/<wbr>scene.glb</code>" in files
    # A cell that breaks anywhere beside one that never does is one letter wide on a phone.
    style = page[page.index("<style>") : page.index("</style>")]
    assert "anywhere" not in re.search(r"dl\.files dd \{[^}]*\}", style).group()


def test_plots_are_dark_in_the_dark_and_do_not_shrink(page):
    assert page.count('<img class="plot"') == 2 * 2 + 1, "plan and layers of two rooms, and the curves"
    style = re.sub(r"\s+", " ", page)
    dark = style[style.index("{ /* Black ink") :]
    assert "img.plot { background: #fff; filter: invert(" in dark[:300]
    assert re.search(r"\.plot \{ min-width: \d+rem; \}", style)
