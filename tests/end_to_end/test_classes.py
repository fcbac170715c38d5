# SPDX-License-Identifier: Apache-2.0
"""Classes of one's own, from the command line through training into every result."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest
import torch
import trimesh

from raytran import load
from raytran.checkpoints.file import read_checkpoint
from raytran.checkpoints.runs import LAST
from raytran.data.scan2cad import annotation_path, read_annotations
from raytran.errors import CheckpointError, DataError
from raytran.run.entry import compose
from raytran.run.export.export_model import described, export_model
from raytran.viewer.data import read_viewer_scene

from .runs import fit, table

NAMES = ["drill", "lathe 2", "bench"]


@pytest.fixture(scope="module")
def own(rooms) -> list[str]:
    """Settings by which every object of the rooms is of one of three made-up classes."""
    scenes = read_annotations(annotation_path(rooms)).values()
    categories = sorted({name.split("/")[0] for scene in scenes for name in scene.model_id})
    assert len(categories) >= 3
    listed = [categories[i::3] for i in range(3)]
    return [f"classes.names={json.dumps(NAMES)}", f"classes.catids={json.dumps(listed)}"]


@pytest.fixture(scope="module")
def trained(settings, own, command, tmp_path_factory) -> Path:
    """A run of stage 2, with all that looks at classes, of four steps."""
    folder = tmp_path_factory.mktemp("own")
    words = ["experiment=stage2", "init_from=none", "watch.pictures=1", f"output_dir={folder / 'run'}"]
    more = "model/extensions=[proposal_queries,windowed_attention,denoising]"
    done = command("train", *settings, *own, *words, more, folder=folder)
    assert done.returncode == 0, done.stderr
    return folder / "run" / LAST


def test_training_and_the_checkpoint(trained):
    names = {name for row in table(trained.parents[1]) for name in row}
    assert {name for name in names if name.startswith("val/objects/accuracy/")} <= {
        f"val/objects/accuracy/{name}" for name in NAMES
    }
    assert any(name.startswith("val/objects/accuracy/") for name in names)
    content = read_checkpoint(trained)
    assert content["model"]["classes"]["names"] == NAMES
    shapes = {
        name.removeprefix("model.heads.objects."): value.shape[0]
        for name, value in content["state_dict"].items()
        if name.endswith(("category.weight", "denoising_queries.embedding"))
    }
    assert {name: size for name, size in shapes.items() if not name.startswith("predictors")} == {
        "queries.category.weight": 3,
        "denoising_queries.embedding": 3,
    }
    assert {size for name, size in shapes.items() if name.startswith("predictors")} == {4}
    given_away = trained.with_name("own.safetensors")
    export_model(compose("export_model", [f"checkpoint={trained}", f"output={given_away}"]))
    assert load(trained).classes == load(given_away).classes
    assert load(given_away).classes.names == tuple(NAMES)
    assert ", ".join(NAMES) in list(described(content, trained).columns[1].cells)


def test_evaluate_and_predict_take_them_from_the_checkpoint(trained, settings, rooms, command, tmp_path):
    words = [f"checkpoint={trained}", "score_threshold=0"]
    data = [setting for setting in settings if setting.startswith("data.")]
    done = command("evaluate", *words, *data, "output=results", "num_resamples=5", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "results/metrics.json").read_text())["strict"]
    assert list(metrics["per_class"]) == list(metrics["atlas"]["per_class"]) == NAMES
    assert metrics["n_total"] == sum(entry["n_total"] for entry in metrics["per_class"].values()) > 0
    scene = next((rooms / "scannet" / "scans").iterdir())
    truth = f"truth={annotation_path(rooms)}"
    more = [
        f"scene={scene}",
        "output=room",
        "check=false",
        "num_views=3",
        truth,
        "num_overlays=1",
        "turntable=0",
    ]
    done = command("predict", *words, *more, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    found = [entry["category"] for entry in json.loads((tmp_path / "room/scene.json").read_text())["objects"]]
    assert found
    assert set(found) <= set(NAMES)
    nodes = set(trimesh.load(tmp_path / "room/scene.glb").graph.nodes_geometry)
    assert {f"{i:02d}_{name}_box" for i, name in enumerate(found)} <= nodes
    shown = read_viewer_scene(tmp_path / "room")
    assert list(shown.objects.category) == found
    assert shown.truth.classes.names == tuple(NAMES)
    assert len(shown.truth) > 0
    words = ["classes.names=[drill,lathe]", f"checkpoint={trained}", *data]
    done = command("evaluate", *words, folder=tmp_path)
    assert done.returncode == 1
    assert "has 3 classes with 'lathe 2' and without 'lathe', which are others" in done.stderr


def test_a_parent_gives_all_but_its_class_layers(trained, settings, tmp_path, caplog):
    """Nothing moves at a learning rate of 0, so that the first weights are those of the last checkpoint."""
    still = [
        "experiment=stage2",
        "schedule.stage2.learning_rate=0",
        "trainer.max_steps=1",
        f"init_from={trained}",
    ]
    more = "model/extensions=[proposal_queries,windowed_attention,denoising]"
    with caplog.at_level(logging.INFO, logger="raytran"):
        fit(settings, tmp_path / "run", *still, more, "trainer.val_check_interval=1")
    said = [record.getMessage() for record in caplog.records if "starts at random" in record.getMessage()]
    assert said == [
        "what tells the 9 classes apart starts at random: its parent has 3 classes with 'drill' and without "
        "'bathtub'"
    ]
    before, after = (read_checkpoint(path)["state_dict"] for path in (trained, tmp_path / "run" / LAST))
    moved = {
        name
        for name, value in after.items()
        if value.shape != before[name].shape or not torch.equal(value, before[name])
    }
    statistics = ("running_mean", "running_var", "num_batches_tracked")
    layers = tuple(f"model.{layer}" for layer in load(tmp_path / "run" / LAST).class_layers())
    assert {name for name in moved if not name.endswith(statistics)} == {
        name for name in after if name.startswith(layers)
    }


def test_as_many_classes_of_other_names_are_other_classes(trained, settings, own, tmp_path):
    renamed = [own[0].replace("bench", "stool"), own[1]]
    with pytest.raises(
        CheckpointError, match="3 classes with 'bench' and without 'stool': give the classes that"
    ):
        fit(
            settings,
            trained.parents[1],
            "experiment=stage2",
            f"resume={trained}",
            "trainer.max_steps=6",
            *renamed,
        )
    frozen = ["experiment=stage3", "check_parent=none", f"init_from={trained}"]
    more = "model/extensions=[proposal_queries,windowed_attention,denoising]"
    with pytest.raises(
        CheckpointError, match="stage3 does not train what tells classes apart: train experiment="
    ):
        fit(settings, tmp_path / "run", *frozen, more, *renamed)


def test_data_of_no_class(settings, tmp_path):
    words = ["experiment=stage2", "init_from=none", "classes.names=[drill,lathe]"]
    with pytest.raises(DataError, match=r"none of the \d+ annotated objects, of categories '0.* name those"):
        fit(settings, tmp_path / "run", *words)
