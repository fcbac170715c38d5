# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from raytran.data.prepare.annotation import Annotations
from raytran.data.prepare.sources import select_scans
from raytran.data.scannet.find import ScanSource
from raytran.errors import ConfigError, DataError

ROOT = Path("/scannet")
FOUND = {name: (ScanSource(name, "exporter", ROOT / name),) for name in ("a1", "a2", "b1", "t1", "x1")}
LISTED = {"train": ["b1", "a1", "gone"], "val": ["a2"], "test": ["t1"]}
ANNOTATIONS = Annotations(entries={name: {"id_scan": name} for name in ("a1", "a2", "gone", "far", "x1")})


def select(scenes=None, splits=("train", "val"), listed=LISTED, annotations=ANNOTATIONS, found=FOUND):
    return select_scans(found, listed, annotations, root=ROOT, scenes=scenes, splits=splits)


def taken(selection):
    return [job.scene_id for job in selection.jobs]


def test_annotated_scans_of_the_splits():
    chosen = select()
    assert taken(chosen) == ["a1", "a2"]
    assert chosen.jobs[0].entry == {"id_scan": "a1"}
    assert chosen.splits == {"train": ["b1", "a1", "gone"], "val": ["a2"]}
    assert chosen.without_annotation == ["b1"]
    assert chosen.without_scan == ["gone"]
    assert chosen.in_no_split == ["x1"]


def test_without_split_files_every_scan_counts():
    chosen = select(listed={})
    assert taken(chosen) == ["a1", "a2", "x1"]
    assert chosen.splits == {}
    assert chosen.without_scan == ["far", "gone"]
    assert chosen.without_annotation == ["b1", "t1"]


def test_without_annotations_every_scan_counts():
    chosen = select(annotations=None, splits=("train", "test"))
    assert taken(chosen) == ["a1", "b1", "t1"]
    assert chosen.without_annotation == chosen.without_scan == []


def test_scans_asked_for_by_name_need_no_annotation():
    chosen = select(scenes=["b1"])
    assert taken(chosen) == ["b1"]
    assert chosen.jobs[0].entry is None
    assert chosen.without_annotation == ["b1"]
    assert taken(select(scenes=["a*"])) == ["a1", "a2"]
    assert taken(select(scenes=["a*"], splits=["val"])) == ["a2"]


def test_the_best_of_several_sources_comes_first():
    both = (*FOUND["a1"], ScanSource("a1", "frames_25k", ROOT / "more" / "a1"))
    chosen = select(found=FOUND | {"a1": both})
    assert chosen.jobs[0].sources == both
    assert chosen.duplicates == {"a1": ["exporter: a1", "frames_25k: more/a1"]}


@pytest.mark.parametrize(
    ("arguments", "kind", "said"),
    [
        ({"splits": ["training"]}, ConfigError, "choose from train, val, test"),
        ({"scenes": ["a1", "zz*"]}, DataError, r"called zz\*: check scenes="),
        ({"scenes": ["t1"]}, DataError, r"t1 is in none of splits=\[train, val\]"),
        ({"splits": ["test"]}, DataError, "none of the 1 chosen scans in /scannet has objects"),
        ({"listed": {"train": ["gone"]}}, DataError, "none of the scans that were asked for is in /scannet"),
    ],
)
def test_what_leaves_nothing_to_do_is_said(arguments, kind, said):
    with pytest.raises(kind, match=said):
        select(**arguments)
