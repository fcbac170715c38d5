# SPDX-License-Identifier: Apache-2.0
"""A backbone of one's own, from its first stage to an exported file: as docs/own-network.md says."""

from __future__ import annotations

import functools
import json
import os
import re
import sys

import pytest
import torch

import raytran
from raytran.errors import CheckpointError, ConfigError

pytestmark = pytest.mark.slow

REFUSED = "asks to run 'mylab.MyBackbone', which is no network of raytran"
REMEDY = "give trust=[mylab]"


@pytest.fixture(scope="module")
def lab(tmp_path_factory, project_root):
    """The package and the folder of configs that the page shows."""
    page = (project_root / "docs" / "own-network.md").read_text(encoding="utf-8")
    files = re.findall(r"^```\w+\n# lab/(\S+)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert [name for name, _ in files] == ["src/mylab/__init__.py", "conf/model/backbone/mine.yaml"]
    folder = tmp_path_factory.mktemp("lab")
    for name, content in files:
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_text(content)
    return folder


@pytest.fixture(scope="module")
def run(lab, command):
    """Run a command as the owner of the package does."""
    path = os.pathsep.join([str(lab / "src"), os.environ.get("PYTHONPATH", "")])
    return functools.partial(command, folder=lab, PYTHONPATH=path)


@pytest.fixture(scope="module")
def fits(run, settings):
    """Stages 1 and 2, the second from the first that ``init_from=auto`` finds."""
    network = ["--config-dir", "conf", "model/backbone=mine"]
    return [
        run("train", *network, *settings, "experiment=stage1"),
        run("train", *network, *settings, "experiment=stage2", "trust=[mylab]"),
    ]


@pytest.fixture(scope="module")
def checkpoint(fits, lab):
    assert [fit.returncode for fit in fits] == [0, 0], fits[-1].stderr
    (path,) = lab.glob("outputs/tiny/stage2/*/checkpoints/last.ckpt")
    return path


@pytest.fixture
def importable(lab, monkeypatch):
    monkeypatch.syspath_prepend(lab / "src")
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "mylab"]:
        del sys.modules[name]


def test_two_stages_train_and_say_what_is_needed(fits, checkpoint):
    line = "this network has classes of mylab: to use its checkpoints, evaluate, predict and export_model "
    said = [fit.stdout + fit.stderr for fit in fits]
    assert line in said[0]
    assert "need trust=[mylab]" in said[0]
    assert line not in said[1], "trust=[mylab] was given: it is known"
    card = torch.load(checkpoint, weights_only=True)
    assert card["model"]["backbone"]["_target_"] == "mylab.MyBackbone"
    assert card["parent"]["stage"] == "stage1"


def test_evaluate(run, checkpoint, rooms, lab):
    words = ("evaluate", f"checkpoint={checkpoint}", f"data.root={rooms}", "output=results")
    refused = run(*words)
    assert refused.returncode == 1
    assert REFUSED in refused.stderr
    assert REMEDY in refused.stderr
    assert len(refused.stderr.splitlines()) == 1
    assert not (lab / "results").exists()
    done = run(*words, "trust=[mylab]")
    assert done.returncode == 0, done.stderr
    assert json.loads((lab / "results" / "metrics.json").read_text())["strict"]["n_scenes"] == 1


def test_predict(run, checkpoint, rooms, lab):
    scan = sorted((rooms / "scannet" / "scans").iterdir())[0]
    words = ("predict", f"checkpoint={checkpoint}", f"scene={scan}", "output=prediction", "viewer=false")
    refused = run(*words)
    assert refused.returncode == 1
    assert REFUSED in refused.stderr
    assert REMEDY in refused.stderr
    done = run(*words, "check=false", "turntable=0", "trust=[mylab]")
    assert done.returncode == 0, done.stderr
    assert (lab / "prediction" / "scene.json").is_file()


def test_export_model_and_what_it_writes(run, checkpoint, lab, importable):
    words = ("export_model", f"checkpoint={checkpoint}", "output=mine.safetensors")
    refused = run(*words)
    assert refused.returncode == 1
    assert REFUSED in refused.stderr
    assert not (lab / "mine.safetensors").exists()
    assert run(*words[:-1]).returncode == 0, "what a file says of itself needs no network"
    done = run(*words, "trust=[mylab]")
    assert done.returncode == 0, done.stderr
    # The exported file is used by the same rule, in Python too.
    for path in (checkpoint, lab / "mine.safetensors"):
        with pytest.raises(CheckpointError, match="which is no network of raytran"):
            raytran.load(path)
        model = raytran.load(path, trust=("mylab",))
        assert type(model.backbone).__module__ == "mylab"
        assert model.backbone.gain == 2.0
    with pytest.raises(ConfigError, match=r"write it as trust=\[mylab\]"):
        raytran.load(checkpoint, trust="mylab")


def test_without_the_package_it_is_one_sentence(checkpoint):
    with pytest.raises(CheckpointError, match="set PYTHONPATH so that Python finds the mylab it was trained"):
        raytran.load(checkpoint, trust=["mylab"])


@pytest.mark.parametrize(
    "words",
    [
        ("curriculum", "stages=[stage1]", "trainer=ddp_cpu"),
        ("train", "--multirun", "seed=1", "trainer=cpu"),
    ],
)
def test_commands_that_start_others_hand_the_configs_on(words, run, settings, lab):
    """Ranks of a curriculum's stage and jobs of a sweep find the folder that ``--config-dir`` names."""
    name, *more = words
    common = [item for item in settings if item != "trainer=cpu"]
    flags = [word for word in more if word.startswith("--")]
    typed = ["model/backbone=mine", *common, f"outputs={name}", *(word for word in more if word not in flags)]
    done = run(name, *flags, "--config-dir", "conf", *typed, starts=1)
    assert done.returncode == 0, done.stdout + done.stderr
    (path,) = (lab / name).glob("**/last.ckpt")
    assert torch.load(path, weights_only=True)["model"]["backbone"]["_target_"] == "mylab.MyBackbone"
