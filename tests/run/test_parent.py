# SPDX-License-Identifier: Apache-2.0
"""What a stage asks of the one before."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from raytran.errors import CheckpointError, ConfigError
from raytran.run.entry import compose
from raytran.run.parent import Parent, check_parent, find_parent
from raytran.run.settings import RunConfig
from raytran.run.train import _stage


def stage(experiment, *more):
    return _stage(compose("train", ["preset=tiny", f"experiment={experiment}", "output_dir=unused", *more]))


def parent(name, **scores):
    return Parent(
        "p.ckpt", name, 9, {f"val/{key.replace('__', '/')}": value for key, value in scores.items()}
    )


@pytest.mark.parametrize(
    ("experiment", "found"),
    [
        ("stage1", parent("joint")),  # the first stage asks for nothing
        ("stage2", parent("occupancy", occupancy__iou=0.2)),
        ("stage2", parent("joint")),  # more of the same
        ("stage3", Parent("p.ckpt", "joint", 9, {"val/objects/f1_0.25": 0.01})),
        ("novel_view", parent("occupancy")),
        ("novel_view", parent("joint")),
        ("novel_view", parent("shape")),
        ("novel_view", parent("view")),
    ],
)
def test_a_parent_that_knows_its_task_will_do(experiment, found):
    check_parent(found, stage(experiment), "scores")


@pytest.mark.parametrize(
    ("experiment", "found", "message"),
    [
        (
            "stage2",
            parent("occupancy", occupancy__iou=0.0312),
            r"p\.ckpt has not learned occupancy: its validation occupancy/iou is 0\.0312 and must exceed "
            r"0\.05 \(stage\.parent_minimum\): train experiment=stage1 longer, or force it with ",
        ),
        ("stage2", parent("occupancy", occupancy__iou=float("nan")), "is nan and must exceed"),
        ("stage2", parent("occupancy"), "has never been validated, so that its occupancy/iou is unknown"),
        (
            "stage2",
            parent("shape"),
            "is of stage shape, but stage joint builds on occupancy: train experiment=stage1",
        ),
        ("stage3", parent("occupancy", occupancy__iou=0.9), "builds on joint: train experiment=stage2 first"),
        ("stage3", Parent("p.ckpt", "joint", 9, {"val/objects/f1_0.25": 0.0}), "has not learned objects"),
        ("stage2", parent("view"), "is of stage view, but stage joint builds on occupancy"),
    ],
)
def test_others_are_refused_unless_forced(experiment, found, message, caplog):
    with pytest.raises(CheckpointError, match=message) as refused:
        check_parent(found, stage(experiment), "scores")
    forced = re.search("check_parent=(stage|none)$", str(refused.value)).group(1)
    check_parent(found, stage(experiment), forced)
    assert ("builds on" in caplog.text) == (forced == "none")


def test_the_stage_is_asked_for_without_the_scores():
    check_parent(parent("occupancy"), stage("stage2"), "stage")
    with pytest.raises(CheckpointError, match="builds on occupancy"):
        check_parent(parent("shape"), stage("stage2"), "stage")


def test_the_minimum_is_a_setting():
    learned = parent("occupancy", occupancy__iou=0.2)
    with pytest.raises(CheckpointError, match=r"must exceed 0\.3"):
        check_parent(learned, stage("stage2", "stage.parent_minimum=0.3"), "scores")


def test_what_is_remembered_of_a_parent():
    content = {"stage": "occupancy", "global_step": 7, "scores": {"val/occupancy/iou": 0.5, "step": 6}}
    found = Parent.of(Path("p.ckpt"), content)
    assert found.as_plain() == {
        "path": "p.ckpt",
        "stage": "occupancy",
        "step": 7,
        "scores": {"val/occupancy/iou": 0.5, "step": 6.0},
    }
    assert Parent.of(Path("p.ckpt"), {"stage": "occupancy"}).scores == {}
    for odd in ({"scores": {"a": "b"}}, {"global_step": "many"}):
        with pytest.raises(CheckpointError, match=r"p\.ckpt"):
            Parent.of(Path("p.ckpt"), {"stage": "occupancy", **odd})


def test_where_a_parent_is_looked_for(tmp_path):
    def find(experiment, *more):
        settings = [
            "preset=tiny",
            f"experiment={experiment}",
            "output_dir=unused",
            f"outputs={tmp_path}",
            *more,
        ]
        cfg = compose("train", settings)
        return find_parent(RunConfig.read(cfg), _stage(cfg))

    assert find("stage1") is None
    assert find("stage2", "init_from=none") is None
    assert find("stage1", "init_from=a.ckpt") == Path("a.ckpt")
    with pytest.raises(ConfigError, match=r"`python -m raytran\.train experiment=stage2 preset=tiny` first"):
        find("stage3")
