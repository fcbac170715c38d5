# SPDX-License-Identifier: Apache-2.0
"""Data are known: a stage finds its parent on the same ones, and results say which they are of."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from raytran.checkpoints.runs import read_finished
from raytran.data.scan2cad import annotation_digest, annotation_path
from raytran.errors import ConfigError

from .runs import fit

REPEATED = "scans have 6 frames, fewer than the 8 asked for: frames are repeated"


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    return tmp_path_factory.mktemp("outputs")


@pytest.fixture(scope="module")
def parent(settings, outputs):
    """A stage 1 of two steps on the rooms of all tests."""
    steps = ["trainer.max_steps=2", "trainer.val_check_interval=2"]
    return fit(settings, outputs / "tiny" / "stage1" / "a", f"outputs={outputs}", *steps)


@pytest.fixture(scope="module")
def other_rooms(rooms, tmp_path_factory):
    """The same rooms with one object less."""
    root = tmp_path_factory.mktemp("other") / "rooms"
    shutil.copytree(rooms, root)
    entries = json.loads(annotation_path(root).read_text())
    entries[0]["aligned_models"].pop()
    annotation_path(root).write_text(json.dumps(entries))
    return root


def on(settings, root, name):
    """The settings with other data, chosen as the real ones are."""
    return [
        *(item for item in settings if not item.startswith("data.root")),
        f"data={name}",
        f"data.root={root}",
    ]


def test_checkpoint_and_mark_say_what_was_trained_on(parent, rooms):
    card = torch.load(parent.checkpoint, weights_only=True)
    assert (card["data"]["name"], card["data"]["root"]) == ("rooms", str(rooms))
    assert card["data"]["annotation"] == annotation_digest(rooms)
    assert read_finished(parent.folder).data == card["data"]


def test_a_stage_does_not_start_from_a_parent_on_other_data(
    settings, parent, other_rooms, outputs, tmp_path, command
):
    asked = [*on(settings, other_rooms, "scan2cad"), "experiment=stage2", f"outputs={outputs}"]
    done = command("train", *asked, f"output_dir={tmp_path / 'run'}", folder=tmp_path)
    assert done.returncode == 1
    (said,) = done.stderr.splitlines()
    assert "is on these data, 1 on others: run `raytran train experiment=stage1 preset=tiny" in said
    assert f"there is {parent.checkpoint} on rooms in" in done.stdout
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_a_copy_is_the_same_data(settings, parent, rooms, outputs, tmp_path):
    shutil.copytree(rooms, tmp_path / "moved")
    asked = [*on(settings, tmp_path / "moved", "scan2cad"), "experiment=stage2", f"outputs={outputs}"]
    child = fit(asked, tmp_path / "run", "trainer.max_steps=1", "trainer.val_check_interval=1")
    assert torch.load(child.checkpoint, weights_only=True)["parent"]["path"] == str(parent.checkpoint)


def test_fine_tuning_on_other_data_is_said_in_one_line(
    settings, parent, rooms, other_rooms, tmp_path, caplog
):
    asked = [*on(settings, other_rooms, "scan2cad"), "experiment=stage2", f"init_from={parent.checkpoint}"]
    with caplog.at_level("INFO", "raytran"):
        child = fit(asked, tmp_path / "run", "trainer.max_steps=1", "trainer.val_check_interval=1")
    line = f"its parent was trained on other data, rooms in {rooms}; this run on scan2cad in {other_rooms}"
    assert caplog.messages.count(line) == 1
    card = torch.load(child.checkpoint, weights_only=True)
    assert card["parent"]["data"]["root"] == str(rooms)
    assert card["data"]["root"] == str(other_rooms)


def test_rooms_of_another_seed_are_other_data(settings, parent, outputs, tmp_path):
    """They are not there yet: their settings tell."""
    asked = [item for item in settings if not item.startswith("data.root")]
    with pytest.raises(ConfigError, match="is on these data, 1 on others"):
        fit(
            asked,
            tmp_path / "run",
            "experiment=stage2",
            f"outputs={outputs}",
            f"data.root={tmp_path / 'new'}",
            "rooms.seed=7",
        )
    assert not (tmp_path / "new").exists()


def test_metrics_say_which_scenes_and_how_many_frames(parent, rooms, tmp_path, command):
    asked = [f"checkpoint={parent.checkpoint}", f"data.root={rooms}", "num_views=20"]
    done = command("evaluate", *asked, "output=results", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "results" / "metrics.json").read_text())
    about = {name: metrics[name] for name in ("dataset", "data", "split", "num_views")}
    assert about == {"dataset": "rooms", "data": str(rooms), "split": "val", "num_views": 20}
    assert (done.stdout + done.stderr).count("fewer than the 20 asked for") == 1


def test_repeated_frames_are_said_once(settings, tmp_path, caplog):
    """However often a training validates."""
    with caplog.at_level("WARNING", "raytran"):
        fit(
            settings,
            tmp_path / "run",
            "views.num_views=8",
            "trainer.max_steps=2",
            "trainer.val_check_interval=1",
        )
    assert [message.split(" (")[0] for message in caplog.messages if "fewer" in message] == [REPEATED]
    caplog.clear()
    fit(
        settings,
        tmp_path / "enough",
        "views.num_views=6",
        "trainer.max_steps=1",
        "trainer.val_check_interval=1",
    )
    assert not any("fewer" in message for message in caplog.messages)
