# SPDX-License-Identifier: Apache-2.0
"""A checkpoint for the commands that take one."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from raytran.model import RayTran
from raytran.run.build import build_model, plain
from raytran.run.checkpoint import checkpoint_card
from raytran.run.entry import compose
from raytran.training.checkpoint_file import write_checkpoint


class Trained(NamedTuple):
    """A checkpoint as training writes it, and the network in it."""

    path: Path
    model: RayTran


@pytest.fixture(scope="package")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    settings = [
        "preset=tiny",
        "model.grid_resolution=[8,8,4]",
        "model.backbone.num_blocks=1",
        "views.image_size=[32,48]",
        "model.backbone.resnet.weights=/home/me/resnet.pth",
    ]
    config = compose("train", [*settings, "data.root=/home/me/rooms", f"output_dir={folder}"])
    model = build_model(config, pretrained=False)
    parent = {"path": "/home/me/stage2/last.ckpt", "stage": "joint", "step": 3, "scores": {"val/loss": 1.0}}
    card = checkpoint_card(stage="shape", preset="tiny", config=plain(config), parent=parent)
    state = {f"model.{name}": value for name, value in model.state_dict().items()}
    scores = {"val/objects/f1_0.25": 0.5, "val/objects/f1_0.25/chair": 0.7}
    more = {"scores": scores, "global_step": 40, "optimizer_states": [{}]}
    path = folder / "last.ckpt"
    write_checkpoint(path, {**card, **more, "state_dict": {**state, "loss.scale": torch.ones(1)}})
    return Trained(path, model)


@pytest.fixture
def mylab(tmp_path, monkeypatch):
    """A package of the user's own, with networks and other things in it."""
    (tmp_path / "mylab").mkdir()
    (tmp_path / "mylab" / "__init__.py").write_text(
        "from torch.nn import Linear\nfrom mylab.nets import Head, MyBackbone\n"
        "def run(**_): raise SystemExit('run')\nclass Settings:\n    def __init__(self, **_): run()\n"
    )
    (tmp_path / "mylab" / "nets.py").write_text(
        "from raytran.backbone.backbone import Backbone\nfrom raytran.heads.shape import ShapeHead\n"
        "class MyBackbone(Backbone): pass\n"
        "class Head(ShapeHead):\n"
        "    def __init__(self, *, attention, weights, **settings):\n"
        "        super().__init__(**settings)\n        self.told = attention, weights\n"
    )
    (tmp_path / "broken.py").write_text("import no_such_package\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] in ("mylab", "broken")]:
        del sys.modules[name]
