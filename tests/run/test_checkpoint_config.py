# SPDX-License-Identifier: Apache-2.0
"""Configs that a stranger may have put into a checkpoint."""

from __future__ import annotations

import copy
import sys

import pytest

from raytran.errors import CheckpointError
from raytran.model import RayTran
from raytran.run.build import plain
from raytran.run.checkpoint_config import build_network
from raytran.run.entry import compose


@pytest.fixture(scope="module")
def config():
    return plain(compose("train", ["preset=tiny", "output_dir=unused"]).model)


def changed(config, path, value):
    config = copy.deepcopy(config)
    *front, last = path.split(".")
    node = config
    for name in front:
        node = node[name]
    node[last] = value
    return config


def test_what_training_writes_is_built(config):
    network = build_network(config, "a.ckpt")
    assert isinstance(network, RayTran)
    assert network.grid_resolution == tuple(config["grid_resolution"])


@pytest.fixture
def marked(tmp_path, monkeypatch):
    """A module that says when it is imported, also under a name inside raytran's own modules."""
    (tmp_path / "stranger.py").write_text(
        f"open({str(tmp_path / 'imported')!r}, 'w').close()\ndef run(**_): pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path / "imported"
    sys.modules.pop("stranger", None)


@pytest.mark.parametrize("place", ["_target_", "backbone._target_", "heads.shape._target_", "grid_extent"])
def test_a_stranger_is_not_even_imported(config, marked, place):
    value = "stranger.run" if place.endswith("_target_") else [{"_target_": "stranger.run"}]
    with pytest.raises(CheckpointError, match=r"a\.ckpt asks to run 'stranger\.run'.*do not use"):
        build_network(changed(config, place, value), "a.ckpt")
    assert not marked.exists()
    __import__("stranger")
    assert marked.exists(), "the module was harmless: this test proved nothing"


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "raytran.run.provenance.subprocess.run",  # reached through a module of ours
        "raytran.run.provenance.git_commit",  # ours, and no network
        "raytran.backbone.resnet.torch.hub.load",
        "raytran.heads.shape.Tensor",  # imported there, defined elsewhere
        "raytran.backbone.resnet.nn.Linear",
        "raytran.backbone.resnet.load_state_dict_from_url",
        "raytran.backbone..resnet.ResNet18",
        "raytran.model",
        "raytran.heads.os.system",
        "RayTran",
        "",
        None,
        7,
    ],
)
def test_only_networks_of_raytran_are_built(config, target):
    for place in ("_target_", "backbone.resnet._target_"):
        with pytest.raises(CheckpointError, match="which is no network of raytran"):
            build_network(changed(config, place, target), "a.ckpt")


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("_args_", [["true"]]),
        ("backbone._partial_", True),
        ("backbone._recursive_", False),
        ("heads.__class__", "x"),
        ("backbone.channels", print),
        ("heads.3", {}),
    ],
)
def test_hydras_other_words_and_odd_values_are_refused(config, place, value):
    with pytest.raises(CheckpointError, match=r"a\.ckpt"):
        build_network(changed(config, place, value), "a.ckpt")


def test_references_are_text(config):
    """``${oc.env:HOME}`` would be looked up by OmegaConf; here it is a word that fits nowhere."""
    with pytest.raises(CheckpointError, match="cannot be built"):
        build_network(changed(config, "backbone.channels", "${oc.env:HOME}"), "a.ckpt")


@pytest.mark.parametrize("weights", ["imagenet", "auto", "/etc/passwd"])
def test_nothing_is_read_or_fetched(config, weights, monkeypatch):
    monkeypatch.setattr("torch.hub.load_state_dict_from_url", lambda *_, **__: pytest.fail("fetched"))
    monkeypatch.setattr("torch.load", lambda *_, **__: pytest.fail("read"))
    assert isinstance(build_network(changed(config, "backbone.resnet.weights", weights), "a.ckpt"), RayTran)


@pytest.mark.parametrize(("place", "value"), [("backbone.depth", 3), ("backbone.channels", -4), ("heads", 5)])
def test_settings_that_do_not_fit_are_one_sentence(config, place, value):
    with pytest.raises(CheckpointError, match=r"the network described in a\.ckpt cannot be built \("):
        build_network(changed(config, place, value), "a.ckpt")


def test_a_part_is_no_network(config):
    with pytest.raises(CheckpointError, match="no network"):
        build_network({"channels": 3}, "a.ckpt")
