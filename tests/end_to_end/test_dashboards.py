# SPDX-License-Identifier: Apache-2.0
"""What a run leaves in its table, TensorBoard's files and the offline folder of W&B, read back."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from raytran.run.entry import compose
from raytran.run.train.fit import train
from raytran.training.history import read_history
from raytran.training.loggers import WANDB_ID

STEPS = (2, 4)
PICTURES = {"masks", "occupancy", "topdown", "boxes"}


@pytest.fixture(scope="module")
def run(settings, tmp_path_factory):
    """The folder of a run of stage 2, stopped after two steps and resumed, with all loggers."""
    import wandb

    folder = tmp_path_factory.mktemp("dashboards") / "run"
    with pytest.MonkeyPatch.context() as context:
        context.setenv("WANDB_MODE", "offline")
        context.setenv("WANDB_SILENT", "true")
        words = [*settings, "experiment=stage2", "init_from=none", "logger=many", f"output_dir={folder}"]
        for steps in STEPS:
            train(compose("train", [*words, f"trainer.max_steps={steps}", "resume=auto"]))
            (folder / "finished.json").unlink()
            wandb.finish()
    return folder


@pytest.fixture(scope="module")
def scene(rooms):
    """The validation scene's name."""
    (name,) = (rooms / "scannet" / "scannetv2_val.txt").read_text().split()
    return name


def test_the_table_has_everything(run):
    history = read_history(run)
    for name in (
        *("train/total", "train/occupancy", "train/foreground", "train/objects/yaw"),
        *("train/objects/class/layer0", "val/objects/center", "val/objects/accuracy_global"),
        *("val/occupancy/iou", "health/class_entropy", "health/gradient/objects", "health/skipped_steps"),
        *("time/data", "time/compute", "time/scenes_per_second", "memory/process", "schedule/learning_rate"),
    ):
        assert history[name], name
    assert [step for step, _ in history["train/total"]] == [0, 1, 2, 3]
    assert any(name.startswith("val/objects/f1_0.25/") for name in history), "metrics per class"


def test_pictures_of_the_same_scenes_each_time(run, scene):
    for step in STEPS:
        folder = run / "pictures" / f"step-{step:06d}" / scene
        assert {path.stem for path in folder.iterdir()} == PICTURES
        for path in folder.iterdir():
            assert np.asarray(Image.open(path).convert("L")).std() > 1, f"{path} is blank"


def test_tensorboard_reads_it(run, scene):
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("train/total")] == [0, 1, 2, 3]
    assert set(events.Tags()["images"]) == {f"pictures/{scene}/{name}" for name in PICTURES}
    shown = events.Images(f"pictures/{scene}/masks")
    scores = events.Scalars("val/objects/accuracy_global")
    assert [image.step for image in shown] == [event.step for event in scores] == [1, 3]
    assert (shown[0].width, shown[0].height) == Image.open(
        run / "pictures" / "step-000002" / scene / "masks.jpg"
    ).size


def test_wandb_has_pictures_tables_and_boxes(run, scene, rooms):
    folders = sorted(path for path in (run / "wandb").glob("offline-run-*") if path.is_dir())
    # Each part is a run of its own: sent later, none can replace the other.
    assert [folder.name.rpartition("-")[2] for folder in folders] == (run / WANDB_ID).read_text().split()
    assert len({folder.name.rpartition("-")[2] for folder in folders}) == 2
    for folder in folders:
        assert list(folder.glob("run-*.wandb"))
        media = folder / "files" / "media"
        assert len(list((media / "images" / "pictures" / scene).iterdir())) == len(PICTURES)
        (table,) = (media / "table" / "pictures").iterdir()
        content = json.loads(table.read_text())
        assert content["columns"][:4] == ["scene", "kind", "class", "score"]
        true = [row for row in content["data"] if row[1] == "true"]
        assert true
        (points,) = (media / "object3D" / "pictures" / scene).iterdir()
        drawn = json.loads(points.read_text())
        assert len([box for box in drawn["boxes"] if box["label"].startswith("true ")]) == len(true)
        corners = np.array(drawn["boxes"][0]["corners"])
        assert np.allclose(corners.mean(axis=0), true[0][4:7], atol=1e-4)
        assert len(drawn["points"][0]) == 6
