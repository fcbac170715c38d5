# SPDX-License-Identifier: Apache-2.0
"""The weights that the package carries."""

from __future__ import annotations

import hashlib
import inspect

import pytest
from hydra.utils import instantiate

import raytran
from raytran.checkpoints import file as module
from raytran.checkpoints.file import DEFAULT, FOLDER, checkpoint_path, export_weights, read_checkpoint
from raytran.checkpoints.load import load_model, prediction_settings
from raytran.checkpoints.metadata import DataIdentity
from raytran.errors import CheckpointError
from raytran.run.entry import compose
from raytran.run.train.parent import find_parent
from raytran.run.train.settings import RunConfig


@pytest.fixture
def shipped(trained, tmp_path, monkeypatch):
    """A package that carries the weights of a tiny network."""
    folder = tmp_path / "weights"
    monkeypatch.setattr(module, "FOLDER", folder)
    path = folder / "rooms.safetensors"
    export_weights(read_checkpoint(trained.path), trained.path, path, dtype="float16")
    return path


def test_default_means_the_file_of_the_package(shipped):
    assert checkpoint_path("default") == shipped
    assert raytran.load().state_dict().keys() == load_model(shipped).state_dict().keys()
    assert prediction_settings("default") == prediction_settings(shipped)
    config = compose("train", ["experiment=stage3", "preset=tiny", "init_from=default", "output_dir=x"])
    stage = instantiate(config.stage, _convert_="all")
    found = find_parent(RunConfig.read(config), stage, DataIdentity(None, None))
    assert found is not None
    assert found[0] == shipped


def test_default_is_what_predict_and_load_take(shipped):
    assert compose("predict", ["scene=x", "output=x"]).checkpoint == DEFAULT
    assert inspect.signature(raytran.load).parameters["checkpoint"].default == DEFAULT


def test_other_names_are_paths(shipped, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert [str(checkpoint_path(name)) for name in ("./default/", "a.ckpt")] == ["default", "a.ckpt"]
    assert checkpoint_path(tmp_path / "default") == tmp_path / "default"


@pytest.mark.parametrize(("count", "said"), [(0, "no weights"), (2, "2 files of weights, not one,")])
def test_a_package_without_them_says_what_to_do(shipped, count, said):
    if count:
        shipped.with_name("more.safetensors").touch()
    else:
        shipped.unlink()
    with pytest.raises(CheckpointError, match=rf"there are {said} in .*: give checkpoint=FILE, a \.ckpt"):
        raytran.load()


def test_what_the_package_carries_is_whole_and_described():
    """Today's file, if there is one: it loads, and the page beside it names it with its check sum."""
    page = (FOLDER / "README.md").read_text()
    files = sorted(FOLDER.glob("*.safetensors"))
    assert len(files) <= 1
    for path in files:
        assert not load_model(path).training
        assert prediction_settings(path).stage == "stage3"
        assert path.name in page
        assert hashlib.sha256(path.read_bytes()).hexdigest() in page
