# SPDX-License-Identifier: Apache-2.0
"""Choices on which the paper is silent, each seen through a training; exact effects: tests of the parts."""

from __future__ import annotations

import json
import shutil

import pytest
import trimesh

import raytran.backbone.resnet
from raytran.backbone.resnet import ResNet18
from raytran.checkpoints.file import read_checkpoint
from raytran.data.scan2cad import annotation_path
from raytran.data.scannet.scan import read_scan
from raytran.errors import CheckpointError, DataError
from raytran.run.entry import compose
from raytran.run.export.export_model import export_model
from raytran.run.train.fit import RANDOM_ENCODER
from raytran.training.history import read_history

from .runs import fit

ONE_STEP = ["trainer.max_steps=1", "trainer.val_check_interval=1", "watch.pictures=0"]


def first_step(settings, folder, *more):
    """What the first step and the validation after it log, by name."""
    fit(settings, folder, *ONE_STEP, *more)
    return {
        name: values[0][1] for name, values in read_history(folder).items() if name[:4] in ("trai", "val/")
    }


@pytest.fixture(scope="module")
def stages(settings, tmp_path_factory):
    """Checkpoints of stages 1 and 2, of a step each."""
    folder = tmp_path_factory.mktemp("stages")
    first = fit(settings, folder / "stage1", *ONE_STEP)
    second = fit(settings, folder / "stage2", *ONE_STEP, "experiment=stage2", f"init_from={first.checkpoint}")
    return first.checkpoint, second.checkpoint


@pytest.fixture(scope="module")
def usual(settings, stages, tmp_path_factory):
    """The first step of stage 2 as it is without any choice."""
    return first_step(
        settings, tmp_path_factory.mktemp("usual"), "experiment=stage2", f"init_from={stages[0]}"
    )


def test_matching_by_cross_entropy(settings, stages, usual, tmp_path):
    asked = ["experiment=stage2", f"init_from={stages[0]}", "loss.matcher.class_cost=cross_entropy"]
    found = first_step(settings, tmp_path, *asked)
    changed = {name for name in usual if name.startswith("train/objects") and found[name] != usual[name]}
    assert changed, "no other pairs"
    assert not any("proposals" in name for name in changed), "they are not matched"
    assert found["train/occupancy"] == usual["train/occupancy"]


@pytest.mark.parametrize("part", ["center", "yaw"])
def test_betas(settings, stages, usual, part, tmp_path):
    asked = ["experiment=stage2", f"init_from={stages[0]}"]
    square, line = (
        first_step(
            settings, tmp_path / beta, *asked, f"loss.{part}_beta={beta}", f"loss.matcher.{part}_beta=0.1"
        )
        for beta in ("3.0", "0.0")
    )
    for place in ("", "/layer0", "/proposals"):
        name = f"train/objects/{part}{place}"
        assert square[name] < usual[name] < line[name], name
    others = {name for name in usual if name.startswith("train/objects") and f"/{part}" not in name}
    assert all(square[name] == usual[name] for name in others)


def test_betas_of_the_matching_are_those_of_the_loss():
    loss = compose("train", ["preset=tiny", "output_dir=x", "loss.center_beta=0.4", "loss.yaw_beta=0.2"]).loss
    assert (loss.matcher.center_beta, loss.matcher.yaw_beta) == (0.4, 0.2)


def test_shapes_of_all_layers(settings, stages, tmp_path):
    asked = ["experiment=stage3", f"init_from={stages[1]}"]
    last = first_step(settings, tmp_path / "last", *asked)
    every = first_step(settings, tmp_path / "all", *asked, "loss.shape_layers=all")
    more = {f"{split}/shape/layer{layer}" for split in ("train", "val") for layer in (0, 1)}
    assert set(every) - set(last) == more
    assert every["train/shape"] == last["train/shape"]
    terms = [every[f"train/shape{layer}"] for layer in ("", "/layer0", "/layer1")]
    assert every["train/total"] == pytest.approx(sum(terms), rel=1e-5)
    assert last["train/total"] == last["train/shape"]


@pytest.fixture(scope="module")
def crowded(rooms, tmp_path_factory):
    """The rooms with one object more each, kilometres under the floor."""
    root = tmp_path_factory.mktemp("crowded") / "rooms"
    shutil.copytree(rooms, root)
    entries = json.loads(annotation_path(root).read_text())
    for entry in entries:
        below = json.loads(json.dumps(entry["aligned_models"][0]))
        below["trs"]["translation"][2] -= 5000.0
        entry["aligned_models"].append(below)
    annotation_path(root).write_text(json.dumps(entries))
    return root


@pytest.mark.parametrize("choice", ["in_volume", "seen"])
def test_targets_in_the_volume_or_seen(settings, stages, usual, crowded, choice, tmp_path):
    asked = ["experiment=stage2", f"init_from={stages[0]}", f"data.root={crowded}"]
    # The camera sees all other objects of these small rooms, and the volume holds them.
    everything = first_step(settings, tmp_path / "all", *asked)
    assert everything["train/objects/center"] > 100 * usual["train/objects/center"]
    found = first_step(settings, tmp_path / choice, *asked, f"data.dataset.object_choice={choice}")
    assert found == usual


@pytest.mark.slow
def test_a_visible_mask(settings, rooms, tmp_path, command):
    """A shell around every camera hides everything; evaluation gives what training gave."""
    root = tmp_path / "rooms"
    shutil.copytree(rooms, root)
    asked = [*(item for item in settings if not item.startswith("data.root")), f"data.root={root}"]
    asked += ["variant=gt_masks", "data.dataset.input_mask=visible"]
    with pytest.raises(DataError, match=r"_vh_clean_2\.ply, which tells what hides objects"):
        fit(asked, tmp_path / "without", *ONE_STEP)
    meshes = []
    for scan in (root / "scannet" / "scans").iterdir():
        shells = []
        for pose in read_scan(scan).world_from_camera.numpy():
            shells.append(trimesh.creation.icosphere(subdivisions=1, radius=0.1))
            shells[-1].apply_translation(pose[:3, 3])
        meshes.append(scan / f"{scan.name}_vh_clean_2.ply")
        trimesh.util.concatenate(shells).export(meshes[-1])
    visible = first_step(asked, tmp_path / "visible")
    amodal = first_step(asked[:-1], tmp_path / "amodal")
    assert visible["train/total"] != amodal["train/total"]
    checkpoint = tmp_path / "visible" / "checkpoints" / "last.ckpt"
    assert read_checkpoint(checkpoint)["input_mask"] == "visible"
    for mesh in meshes:
        mesh.unlink()
    evaluation = ["evaluate", f"checkpoint={checkpoint}", f"data.root={root}", "output=results"]
    refused = command(*evaluation, folder=tmp_path)
    assert refused.returncode == 1, "it asked for another mask than that of the training"
    assert "_vh_clean_2.ply, which tells what hides objects" in refused.stderr
    done = command(*evaluation, "data.dataset.input_mask=amodal", folder=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def no_network(monkeypatch):
    def fetch():
        raise CheckpointError("there is no network")

    monkeypatch.setattr(raytran.backbone.resnet, "_fetch_imagenet", fetch)


FULL_WIDTH = ["model.backbone.encoder.width=64", "model.backbone.encoder.weights=auto"]


def test_a_random_start_of_the_encoder_is_said_in_capitals(settings, no_network, tmp_path, caplog, capsys):
    """At the start, in the checkpoint, in those of later stages, and in what is given away."""
    line = f"WARNING: {RANDOM_ENCODER}"
    assert RANDOM_ENCODER.startswith("IMAGE ENCODER STARTS FROM RANDOM WEIGHTS")
    with caplog.at_level("INFO", "raytran"):
        first = fit(settings, tmp_path / "stage1", *ONE_STEP, *FULL_WIDTH)
    assert caplog.messages.count(line) == 1
    assert read_checkpoint(first.checkpoint)["warnings"] == [RANDOM_ENCODER]
    caplog.clear()
    more = [*FULL_WIDTH, "experiment=stage2", f"init_from={first.checkpoint}"]
    with caplog.at_level("INFO", "raytran"):
        second = fit(settings, tmp_path / "stage2", *ONE_STEP, *more)
    assert caplog.messages.count(line) == 1
    assert read_checkpoint(second.checkpoint)["warnings"] == [RANDOM_ENCODER]
    (tmp_path / "stage2" / "finished.json").unlink()
    resumed = fit(settings, tmp_path / "stage2", *more, "resume=auto", "trainer.max_steps=2")
    assert read_checkpoint(resumed.checkpoint)["warnings"] == [RANDOM_ENCODER]
    for checkpoint, output in (
        (second.checkpoint, tmp_path / "a.safetensors"),
        (tmp_path / "a.safetensors", None),
    ):
        words = [f"checkpoint={checkpoint}", *([f"output={output}"] if output else [])]
        export_model(compose("export_model", words))
    assert "IMAGE ENCODER STARTS" in capsys.readouterr().out


def test_nothing_is_said_where_weights_were_found_or_not_asked_for(settings, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(raytran.backbone.resnet, "_fetch_imagenet", lambda: ResNet18().state_dict())
    for name, more in (("found", FULL_WIDTH), ("random", [])):
        with caplog.at_level("INFO", "raytran"):
            done = fit(settings, tmp_path / name, *ONE_STEP, *more)
        assert read_checkpoint(done.checkpoint)["warnings"] == []
    assert "IMAGE ENCODER" not in caplog.text
