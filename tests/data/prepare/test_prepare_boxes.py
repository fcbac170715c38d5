# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from raytran.data.dataset import scan2cad_dataset
from raytran.data.prepare.boxed_mesh import box_mesh
from raytran.data.prepare.boxed_objects import BoxedObjects, moved_mesh
from raytran.data.prepare.boxed_scan import scene_name
from raytran.data.prepare.prepare_boxes import choose_splits, prepare_boxes
from raytran.data.prepare.scan import PrepareSettings
from raytran.data.scannet.scan import read_scan
from raytran.errors import ConfigError, DataError

SETTINGS = PrepareSettings((32, 48), max_frames=3)
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
IN_BOX = np.array([[0.9, 0, 0, 3.0], [0, 0.9, 0, 0], [0, 0, 0.9, 1], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Source:
    """A scan with two unit boxes ahead of its cameras; of the first there is a mesh."""

    path: Path
    split: str | None = None
    state: str = "1"
    side: float = 1.0
    away: float = 0.0
    form: str = "test"

    @property
    def scene_id(self):
        return self.path.name

    def open(self):
        return read_scan(self.path)

    def read_objects(self, scan):
        return BoxedObjects(
            named_in="boxes",
            category=("chair", "shower curtain"),
            center=np.array([[3.0, 0, 1], [4, 1 + self.away, 1]]),
            size=np.full((2, 3), self.side),
            rotation=np.stack([UPRIGHT] * 2),
            symmetry=(1, 0),
            mesh=(moved_mesh(box_mesh(), IN_BOX), None),
        )


@pytest.fixture
def sources(write_scan):
    return [Source(write_scan(f"scan{number}")) for number in range(3)]


def prepare(output, sources, settings=SETTINGS, **options):
    return prepare_boxes(output, sources, settings, processes=1, progress=False, **options)


def names(output, split):
    return (output / "scannet" / f"scannetv2_{split}.txt").read_text().split()


def test_boxes_become_what_training_reads(sources, tmp_path):
    output = tmp_path / "out"
    report = prepare(output, sources).report
    assert report["scans"] == {"prepared": 3, "train": 2, "val": 1}
    assert report["objects"]["val"] == {"chair": 1, "shower curtain": 1}
    options = {"cache_dir": output / "cache", "image_size": (32, 48), "num_views": 2}
    scene = scan2cad_dataset(output, "train", **options)[0]
    (objects,) = scene.objects
    torch.testing.assert_close(objects.center, torch.tensor([[3.0, 0, 1], [4, 1, 1]]))
    assert objects.size.eq(1).all()
    assert objects.symmetry.tolist() == [1, 0]
    # The mesh fills 0.9 of its box, so that a margin of 3 cells is empty; of the other only the box is known.
    solid = objects.shape[0].nonzero()
    assert (int(solid.min()), int(solid.max())) == (3, 59)
    assert not objects.shape[1].any()
    stage2 = scan2cad_dataset(output, "train", targets=("objects", "occupancy"), **options)[0]
    assert stage2.objects[0].shape is None
    assert stage2.occupancy.equal(scene.occupancy)
    assert scan2cad_dataset(output, "train", **options).has_shapes()


def test_a_second_call_does_nothing_but_what_has_changed(sources, tmp_path, monkeypatch):
    output = tmp_path / "out"
    prepare(output, sources[:2])
    before = {path: path.stat().st_mtime_ns for path in output.rglob("color/*")}
    changed = replace(sources[0], state="2", side=0.5)
    report = prepare(output, [changed, *sources[1:]]).report
    assert report["scans"]["prepared"] == 3
    entry = json.loads((output / "scannet" / "scans" / "scan0" / "annotation.json").read_text())
    assert entry["aligned_models"][0]["trs"]["scale"] == [0.5, 0.5, 0.5]
    after = {path: path.stat().st_mtime_ns for path in output.rglob("color/*")}
    same = {path.parents[1].name for path in before if before[path] == after.get(path)}
    assert same == {"scan1"}
    # A scan that is not given any more stays, as after a call for a part.
    assert prepare(output, sources[1:]).report["scans"]["prepared"] == 3


def test_other_settings_need_another_folder(sources, tmp_path):
    prepare(tmp_path / "out", sources[:1])
    with pytest.raises(DataError, match="was begun with another max_frames"):
        prepare(tmp_path / "out", sources[:1], replace(SETTINGS, max_frames=2))


def test_scans_that_cannot_be_used_are_named_and_nothing_is_left_of_them(sources, tmp_path):
    output = tmp_path / "out"
    bad = replace(sources[0], side=500.0)
    report = prepare(output, [bad, sources[1]]).report
    assert report["scans"]["prepared"] == 1
    assert (
        "the boxes in boxes are 500 long in the median, so they are in"
        in report["left_out"]["scans_failed"]["scan0"]
    )
    assert sorted(path.name for path in (output / "scannet" / "scans").iterdir()) == ["scan1"]
    assert not list(output.rglob(".unfinished*"))
    with pytest.raises(DataError, match="no scan could be prepared: the boxes in boxes are 500"):
        prepare(tmp_path / "other", [bad])


def test_boxes_out_of_sight_are_noticed(sources, tmp_path):
    report = prepare(tmp_path / "out", [replace(sources[0], away=30.0)]).report
    assert report["noticed"]["objects_unseen"] == {"scan0": "object 1 (shower curtain)"}


def test_splits_follow_the_lists_and_else_the_seed():
    given = dict.fromkeys("abcdefghij")
    splits = choose_splits(given, val_share=0.2, seed=0)
    assert (len(splits["train"]), len(splits["val"])) == (8, 2)
    reversed_order = choose_splits(dict.fromkeys("jihgfedcba"), val_share=0.2, seed=0)
    assert reversed_order == splits
    assert choose_splits(given, val_share=0.2, seed=1)["val"] != splits["val"]
    assert choose_splits({"a": None, "b": None}, val_share=0.2, seed=0)["val"]
    assert choose_splits({"a": None}, val_share=0.2, seed=0) == {"train": ["a"], "val": []}
    own = choose_splits({"a": "val", "b": None, "c": "test", "d": None, "e": None}, val_share=0.5, seed=0)
    assert own == {"train": ["b", "d", "e"], "val": ["a"], "test": ["c"]}
    with pytest.raises(ConfigError, match=r"val_share=1.5 is no share"):
        prepare(Path("x"), [], val_share=1.5)


def test_names_of_scans_are_fit_for_folders():
    assert scene_name("My room (2)") == "My_room_2"
    assert scene_name("../..") == "scan"
    assert scene_name("küche-1") == "küche-1"
