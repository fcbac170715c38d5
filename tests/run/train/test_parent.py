# SPDX-License-Identifier: Apache-2.0
"""What a stage asks of the one before."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from raytran.checkpoints.file import write_checkpoint
from raytran.checkpoints.metadata import DataIdentity, checkpoint_metadata
from raytran.checkpoints.runs import LAST, write_finished
from raytran.errors import CheckpointError, ConfigError
from raytran.run.entry import compose
from raytran.run.train.build import plain
from raytran.run.train.parent import find_parent, stage_of
from raytran.run.train.settings import RunConfig
from raytran.training.callbacks.stage import Parent, check_parent


def stage(experiment, *more):
    return stage_of(compose("train", ["preset=tiny", f"experiment={experiment}", "output_dir=unused", *more]))


def parent(name, **scores):
    return Parent(
        "p.ckpt", name, 9, {f"val/{key.replace('__', '/')}": value for key, value in scores.items()}
    )


@pytest.mark.parametrize(
    ("experiment", "found"),
    [
        ("stage1", parent("stage2")),  # the first stage asks for nothing
        ("stage2", parent("stage1", occupancy__iou=0.2)),
        ("stage2", parent("stage2")),  # more of the same
        ("stage2", parent("stage3")),  # a finished network is trained on, as the package's own
        ("stage3", Parent("p.ckpt", "stage2", 9, {"val/objects/f1_0.25": 0.01})),
        ("novel_view", parent("stage1")),
        ("novel_view", parent("stage2")),
        ("novel_view", parent("stage3")),
        ("novel_view", parent("novel_view")),
    ],
)
def test_a_parent_that_knows_its_task_will_do(experiment, found):
    check_parent(found, stage(experiment), "scores")


@pytest.mark.parametrize(
    ("experiment", "found", "message"),
    [
        (
            "stage2",
            parent("stage1", occupancy__iou=0.0312),
            r"p\.ckpt has not learned occupancy: its validation occupancy/iou is 0\.0312 and must exceed "
            r"0\.05 \(stage\.parent_minimum\): train experiment=stage1 longer, or force it with ",
        ),
        ("stage2", parent("stage1", occupancy__iou=float("nan")), "is nan and must exceed"),
        ("stage2", parent("stage1"), "has never been validated, so that its occupancy/iou is unknown"),
        (
            "stage3",
            parent("stage1", occupancy__iou=0.9),
            "is of stage1, but stage3 builds on stage2: train experiment=stage2 first",
        ),
        ("stage3", Parent("p.ckpt", "stage2", 9, {"val/objects/f1_0.25": 0.0}), "has not learned objects"),
        ("stage2", parent("novel_view"), "is of novel_view, but stage2 builds on stage1"),
    ],
)
def test_others_are_refused_unless_forced(experiment, found, message, caplog):
    with pytest.raises(CheckpointError, match=message) as refused:
        check_parent(found, stage(experiment), "scores")
    forced = re.search("check_parent=(stage|none)$", str(refused.value)).group(1)
    check_parent(found, stage(experiment), forced)
    assert ("builds on" in caplog.text) == (forced == "none")


def test_the_stage_is_asked_for_without_the_scores():
    check_parent(parent("stage1"), stage("stage2"), "stage")
    with pytest.raises(CheckpointError, match="builds on stage1"):
        check_parent(parent("novel_view"), stage("stage2"), "stage")


def test_the_minimum_is_a_setting():
    learned = parent("stage1", occupancy__iou=0.2)
    with pytest.raises(CheckpointError, match=r"must exceed 0\.3"):
        check_parent(learned, stage("stage2", "stage.parent_minimum=0.3"), "scores")


def test_what_is_remembered_of_a_parent():
    content = {"stage": "stage1", "global_step": 7, "scores": {"val/occupancy/iou": 0.5, "step": 6}}
    found = Parent.of(Path("p.ckpt"), content)
    assert found.as_plain() == {
        "path": "p.ckpt",
        "stage": "stage1",
        "step": 7,
        "scores": {"val/occupancy/iou": 0.5, "step": 6.0},
        "data": None,
    }
    known = {"name": "rooms", "root": "r", "annotation": "ab", "made": {"seed": 0}}
    assert Parent.of(Path("p.ckpt"), content | {"data": known}).data == known
    assert Parent.of(Path("p.ckpt"), {"stage": "stage1"}).scores == {}
    for odd in ({"scores": {"a": "b"}}, {"global_step": "many"}):
        with pytest.raises(CheckpointError, match=r"p\.ckpt"):
            Parent.of(Path("p.ckpt"), {"stage": "stage1", **odd})


def find(outputs, experiment, *more):
    settings = ["preset=tiny", f"experiment={experiment}", "output_dir=unused", f"outputs={outputs}", *more]
    cfg = compose("train", settings)
    found = find_parent(RunConfig.read(cfg), stage_of(cfg), DataIdentity.of_config(plain(cfg)))
    return None if found is None else found[0]


def finished(outputs, name, data, *, old=False):
    """A finished stage 1; an old one does not say in its mark what it was trained on."""
    run = outputs / "tiny" / "stage1" / name
    config = plain(compose("train", ["preset=tiny", "output_dir=unused", *data]))
    metadata = checkpoint_metadata(stage="stage1", preset="tiny", config=config, parent=None)
    write_checkpoint(run / LAST, {**metadata, "state_dict": {}})
    known = None if old else metadata["data"]
    write_finished(run, stage="stage1", preset="tiny", experiment="stage1", steps=4, data=known)
    return run / LAST


def test_where_a_parent_is_looked_for(tmp_path):
    assert find(tmp_path, "stage1") is None
    assert find(tmp_path, "stage2", "init_from=none") is None
    with pytest.raises(CheckpointError, match=r"no checkpoint at .*a\.ckpt"):
        find(tmp_path, "stage1", f"init_from={tmp_path / 'a.ckpt'}")
    with pytest.raises(ConfigError, match=r"`raytran train experiment=stage2 preset=tiny` first"):
        find(tmp_path, "stage3")


@pytest.mark.parametrize("old", [False, True])
def test_a_parent_on_other_data_is_passed_over(tmp_path, old, caplog):
    rooms, real = ["data.root=rooms"], ["data=scan2cad", "data.root=real"]
    other = finished(tmp_path, "a", rooms, old=old)
    with pytest.raises(ConfigError) as refused:
        find(tmp_path, "stage2", *real)
    said = str(refused.value)
    assert " is on these data, 1 on others: " in said
    assert caplog.messages == [f"there is {other} on rooms in rooms"]
    assert (
        "run `raytran train experiment=stage1 preset=tiny data=scan2cad data.root=real` first, "
        "or give init_from=CHECKPOINT, or"
    ) in said
    assert find(tmp_path, "stage2", *real, f"init_from={other}") == other
    assert find(tmp_path, "stage2", *rooms) == other
    own = finished(tmp_path, "b", real, old=old)
    finished(tmp_path, "c", rooms, old=old)
    assert find(tmp_path, "stage2", *real) == own, "not the newest, which is on rooms"
    caplog.clear()
    with pytest.raises(ConfigError, match="is on these data, 3 on others"):
        find(tmp_path, "stage2", "data=rooms-v1")
    assert f"there is {own} on scan2cad in real" in caplog.messages
