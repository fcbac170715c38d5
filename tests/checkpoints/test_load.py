# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import subprocess
import sys

import pytest
import torch

import raytran
from raytran.checkpoints.file import write_checkpoint
from raytran.checkpoints.load import fresh_parts, load_weights, prediction_settings
from raytran.checkpoints.metadata import checkpoint_metadata
from raytran.errors import CheckpointError
from raytran.run.entry import compose
from raytran.run.train.build import build_model, plain


@pytest.fixture
def config():
    return compose("train", ["preset=tiny", "model.grid_resolution=[8,8,4]", "output_dir=unused"])


@pytest.fixture
def saved(config, tmp_path):
    """A checkpoint as training writes it, and the model in it."""
    model = build_model(config)
    parent = {"path": "stage1.ckpt", "stage": "stage1", "step": 3, "scores": {}}
    metadata = checkpoint_metadata(stage="stage2", preset="tiny", config=plain(config), parent=parent)
    state = {f"model.{name}": value for name, value in model.state_dict().items()}
    path = tmp_path / "last.ckpt"
    write_checkpoint(path, {**metadata, "state_dict": state})
    return path, model


def test_load_rebuilds_the_model(saved):
    path, model = saved
    loaded = raytran.load(path)
    assert not loaded.training
    assert loaded.grid_resolution == (8, 8, 4)
    state = loaded.state_dict()
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())


def test_the_card_is_complete(saved):
    content = torch.load(saved[0], weights_only=True)
    assert content["format"] == "raytran.checkpoint/2"
    assert (content["stage"], content["preset"], content["parent"]["path"]) == (
        "stage2",
        "tiny",
        "stage1.ckpt",
    )
    assert content["model"]["_target_"] == "RayTran"
    assert content["versions"]["torch"] == torch.__version__
    assert content["git_commit"] is None or len(content["git_commit"].split("+")[0]) == 40


def test_settings_of_prediction(saved, config):
    settings = prediction_settings(saved[0])
    assert settings.image_size == tuple(config.views.image_size)
    assert (settings.num_views, settings.preset) == (config.views.predict_views, "tiny")


def test_a_cut_file_is_one_sentence(saved):
    path = saved[0]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(CheckpointError, match=r"last\.ckpt: the file is damaged or cut short"):
        raytran.load(path)


def test_weights_of_another_model_are_one_sentence(saved):
    other = build_model(compose("train", ["preset=tiny", "model.backbone.channels=24", "output_dir=unused"]))
    content = torch.load(saved[0], weights_only=True)
    with pytest.raises(CheckpointError, match=r"preset tiny\) do not fit this model"):
        load_weights(other, content, saved[0])


@pytest.mark.parametrize(
    ("key", "value"), [("image_size", 5), ("image_size", ["a", "b"]), ("predict_views", None)]
)
def test_settings_that_are_none_are_one_sentence(saved, key, value):
    content = torch.load(saved[0], weights_only=True)
    content["views"][key] = value
    write_checkpoint(saved[0], content)
    with pytest.raises(CheckpointError, match="which images"):
        prediction_settings(saved[0])


def test_a_checkpoint_cannot_run_foreign_code(saved):
    path = saved[0]
    content = torch.load(path, weights_only=True)
    content["model"]["backbone"]["resnet"] = {"_target_": "os.system", "command": "true"}
    write_checkpoint(path, content)
    with pytest.raises(CheckpointError, match=r"last\.ckpt asks to run 'os\.system'"):
        raytran.load(path)


def test_importing_the_package_is_light():
    code = "import sys, raytran; raise SystemExit(any(name in sys.modules for name in ('torch', 'hydra')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_part_that_begins_keeps_its_own_weights_where_the_parent_has_none(config, saved):
    path, parent = saved
    changed = compose(
        "train",
        ["preset=tiny", "model.grid_resolution=[8,8,4]", "experiment=novel_view", "output_dir=unused"],
    )
    torch.manual_seed(1)
    model = build_model(changed)
    fresh = {name: value.clone() for name, value in model.heads["view"].state_dict().items()}
    content = torch.load(path, weights_only=True)
    assert fresh_parts(model, content, []) == []
    with pytest.raises(CheckpointError, match=r"heads\.view"):
        load_weights(model, content, path)
    assert fresh_parts(model, content, ["heads.view"]) == ["heads.view"]
    load_weights(model, content, path, fresh=["heads.view"])
    assert all(torch.equal(value, model.heads["view"].state_dict()[name]) for name, value in fresh.items())
    assert torch.equal(model.backbone.unseen, parent.backbone.unseen)
    # A checkpoint that has the part gives it; one that has only some of it is damaged.
    content["state_dict"] |= {f"model.heads.view.{name}": value + 1 for name, value in fresh.items()}
    assert fresh_parts(model, content, ["heads.view"]) == []
    load_weights(model, content, path)
    assert torch.equal(model.heads["view"].ray_norm.weight, fresh["ray_norm.weight"] + 1)
    del content["state_dict"]["model.heads.view.ray_norm.weight"]
    assert fresh_parts(model, content, ["heads.view"]) == []
    with pytest.raises(CheckpointError, match="ray_norm"):
        load_weights(model, content, path)


def test_a_head_of_another_form_starts_at_random_if_that_of_the_parent_is_random_too(config, saved):
    path, parent = saved
    changed = compose(
        "train",
        [
            "preset=tiny",
            "model.grid_resolution=[8,8,4]",
            "model.heads.objects.queries=null",
            "output_dir=unused",
        ],
    )
    model = build_model(changed)
    own = {name: value.clone() for name, value in model.heads["objects"].state_dict().items()}
    first = {**torch.load(path, weights_only=True), "stage": "stage1", "parent": None}
    first["config"]["stage"] = plain(config.stage)
    assert plain(config.stage)["trainable"] == ["backbone", "heads.occupancy"]
    assert fresh_parts(build_model(config), first, []) == []
    assert fresh_parts(model, first, []) == ["heads.objects"]
    load_weights(model, first, path, fresh=["heads.objects"])
    assert all(torch.equal(value, own[name]) for name, value in model.heads["objects"].state_dict().items())
    assert torch.equal(model.backbone.unseen, parent.backbone.unseen)
    # What was trained, here or by a parent, or what nobody knows of, is not thrown away.
    for trainable in (["heads"], ["heads.objects"], ["heads.objects.decoder"], None):
        first["config"]["stage"]["trainable"] = trainable
        assert fresh_parts(model, first, []) == []
    assert fresh_parts(model, torch.load(path, weights_only=True), []) == []
