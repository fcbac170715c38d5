# SPDX-License-Identifier: Apache-2.0
"""Configs that a stranger may have put into a checkpoint."""

from __future__ import annotations

import copy
import importlib
import json
import sys

import pytest

from raytran.checkpoints.network import (
    PARTS,
    build_network,
    own_packages,
    with_import_paths,
    with_registered_names,
)
from raytran.classes import PAPER_CLASSES
from raytran.errors import CheckpointError, ConfigError
from raytran.model import RayTran
from raytran.run.entry import compose
from raytran.run.train.build import plain


@pytest.fixture(scope="module")
def config():
    return with_registered_names(plain(compose("train", ["preset=tiny", "output_dir=unused"]).model))


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
        "raytran.checkpoints.metadata.subprocess.run",  # reached through a module of ours
        "raytran.checkpoints.metadata.git_commit",  # ours, and no network
        "raytran.backbone.resnet.torch.hub.load",
        "raytran.heads.shape.Tensor",  # imported there, defined elsewhere
        "raytran.backbone.resnet.nn.Linear",
        "raytran.backbone.resnet.load_state_dict_from_url",
        "raytran.backbone..resnet.ResNet18",
        "raytran.model",
        "raytran.heads.os.system",
        "raytran.model.RayTran",  # ours, but not by its registered name
        "Linear",
        "",
        None,
        7,
    ],
)
def test_only_networks_of_raytran_are_built(config, target):
    for place in ("_target_", "backbone.encoder._target_"):
        with pytest.raises(CheckpointError, match="which is no network of raytran"):
            build_network(changed(config, place, target), "a.ckpt")


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("_args_", [["true"]]),
        ("backbone._partial_", True),  # then there is no backbone
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
    assert isinstance(build_network(changed(config, "backbone.encoder.weights", weights), "a.ckpt"), RayTran)


@pytest.mark.parametrize(("place", "value"), [("backbone.depth", 3), ("backbone.channels", -4), ("heads", 5)])
def test_settings_that_do_not_fit_are_one_sentence(config, place, value):
    with pytest.raises(CheckpointError, match=r"the network described in a\.ckpt cannot be built \("):
        build_network(changed(config, place, value), "a.ckpt")


@pytest.mark.parametrize(
    ("place", "value"),
    [
        *[
            ("classes", value)
            for value in ("chair", 9, ["chair"], {"names": 3}, {"names": ["a"] * 9}, {"x": 1})
        ],
        ("classes", {"names": ["chair"]}),  # the head has nine
        ("classes", {"names": [f"c{i}" for i in range(9)], "colors": [[0, 0, 999]] * 9}),
        ("classes", {"names": [f"c{i}" for i in range(9)], "catids": [["1"]] * 9}),
        ("classes", {"names": [f"c{i}${{seed}}" for i in range(9)]}),
        *[("heads.objects.classes", value) for value in (9, None, [], ["a"], "abc", ["a"] * 9_000)],
        *[("heads.objects.queries.classes", value) for value in (9, None)],
    ],
)
def test_classes_that_are_none_are_one_sentence(config, place, value):
    with pytest.raises(
        CheckpointError, match=r"the network described in a\.ckpt cannot be built \(|odd settings"
    ):
        build_network(changed(config, place, value), "a.ckpt", max_tensors=1000)


def test_a_network_that_says_nothing_of_classes_has_the_papers(config):
    earlier = copy.deepcopy(config)
    del (
        earlier["classes"],
        earlier["heads"]["objects"]["classes"],
        earlier["heads"]["objects"]["queries"]["classes"],
    )
    network, now = build_network(earlier, "a.ckpt"), build_network(config, "a.ckpt")
    assert network.classes is PAPER_CLASSES
    assert {name: value.shape for name, value in network.state_dict().items()} == {
        name: value.shape for name, value in now.state_dict().items()
    }


def test_a_part_is_no_network(config):
    with pytest.raises(CheckpointError, match="no network"):
        build_network({"channels": 3}, "a.ckpt")


@pytest.mark.parametrize("target", ["mylab.MyBackbone", "mylab.nets.MyBackbone"])
def test_a_package_that_the_user_trusts_may_be_named(config, mylab, target):
    own = changed(config, "backbone._target_", target)
    with pytest.raises(CheckpointError, match=r"no network of raytran: do not use .* give trust=\[mylab\]$"):
        build_network(own, "a.ckpt")
    assert "mylab" not in sys.modules
    for trust in (["mylab"], ("other", "mylab")):
        network = build_network(own, "a.ckpt", trust=trust)
        assert type(network.backbone).__name__ == "MyBackbone"
    with pytest.raises(CheckpointError, match="do not use this file"):
        build_network(own, "a.ckpt", trust=["my", "nets", "mylab_"])


def test_arguments_of_ones_own_keep_their_names(config, mylab):
    """``attention`` is a word of raytran's networks; only that of weights to start from holds for all."""
    shape = config["heads"]["shape"] | {"_target_": "mylab.Head", "attention": "local", "weights": "a.pth"}
    network = build_network(changed(config, "heads.shape", shape), "a.ckpt", trust=["mylab"])
    assert network.heads["shape"].told == ("local", None)


@pytest.mark.parametrize(
    "target",
    ["mylab.run", "mylab.Settings", "mylab.Linear", "mylab.Missing", "mylab.missing.Head", "mylab.nets"],
)
def test_only_networks_of_a_trusted_package_are_built(config, mylab, target):
    """No functions, no other classes, none that it has only imported from elsewhere."""
    with pytest.raises(
        CheckpointError, match=r"there is no torch\.nn\.Module of that name in mylab: set PYTHONP"
    ):
        build_network(changed(config, "backbone._target_", target), "a.ckpt", trust=["mylab"])


def test_trust_is_never_taken_from_the_file(config, marked):
    """Wherever a file says it: the stranger is not even imported."""
    own = changed(config, "backbone._target_", "stranger.run")
    for place in ("trust", "backbone.trust", "heads.trust"):
        with pytest.raises(CheckpointError, match="do not use this file"):
            build_network(changed(own, place, ["stranger"]), "a.ckpt", trust=["mylab"])
    assert not marked.exists()


def test_what_a_trusted_package_lacks_is_its_own_error(config, mylab):
    with pytest.raises(ModuleNotFoundError, match="no_such_package"):
        build_network(changed(config, "backbone._target_", "broken.Net"), "a.ckpt", trust=["broken"])
    with pytest.raises(CheckpointError, match=r"set PYTHONPATH so that Python finds the absent it was"):
        build_network(changed(config, "backbone._target_", "absent.Net"), "a.ckpt", trust=["absent"])
    wrong = changed(changed(config, "backbone._target_", "mylab.MyBackbone"), "backbone.depth", 3)
    with pytest.raises(
        CheckpointError, match="the file is of another version of raytran or mylab, or damaged"
    ):
        build_network(wrong, "a.ckpt", trust=["mylab"])


@pytest.mark.parametrize("trust", ["mylab", ["mylab.nets"], [3], 5, {"mylab": True}, [""]])
def test_trust_is_a_list_of_packages(config, trust):
    with pytest.raises(ConfigError, match=r"is no list of top-level packages: write it as trust=\[mylab\]"):
        build_network(config, "a.ckpt", trust=trust)


def test_packages_that_a_network_names(config):
    assert own_packages(config) == ()
    own = changed(changed(config, "backbone._target_", "b.nets.Net"), "heads.extra", [{"_target_": "a.Head"}])
    assert own_packages(own) == ("a", "b")


def test_every_registered_part_is_where_it_is_said_to_be():
    for name, module in PARTS.items():
        assert getattr(importlib.import_module(module), name).__module__ == module, name


@pytest.mark.parametrize("preset", ["raytran", "small", "laptop", "tiny"])
def test_names_stand_for_import_paths(preset):
    settings = plain(
        compose("train", [f"preset={preset}", "experiment=novel_view", "output_dir=unused"]).model
    )
    named = with_registered_names(settings)
    assert "raytran." not in json.dumps(named)
    assert with_import_paths(named) == settings


def test_a_part_without_a_name_is_told_when_training_starts():
    with pytest.raises(ConfigError, match=r"raytran\.heads\.new\.NewHead is not registered.*a line in PARTS"):
        with_registered_names({"_target_": "raytran.heads.new.NewHead"})
    assert with_registered_names({"_target_": "mylab.NewHead"}) == {"_target_": "mylab.NewHead"}
