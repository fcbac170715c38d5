# SPDX-License-Identifier: Apache-2.0
"""A weights file is taken wherever a checkpoint is."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf

from raytran.checkpoints.file import read_checkpoint
from raytran.checkpoints.runs import LAST
from raytran.errors import CheckpointError
from raytran.run.entry import compose
from raytran.run.evaluate.evaluate import evaluate
from raytran.run.export.export_model import export_model
from raytran.run.predict.predict import predict

from .runs import fit

STEPS = ["trainer.max_steps=1", "trainer.val_check_interval=1"]


@pytest.fixture(scope="module")
def weights(settings, tmp_path_factory):
    """The weights of a stage 1 of one step."""
    folder = tmp_path_factory.mktemp("exported")
    fit([*settings, *STEPS], folder / "run", "experiment=stage1")
    words = [f"checkpoint={folder / 'run' / LAST}", f"output={folder / 'stage1.safetensors'}"]
    return export_model(compose("export_model", words))


def test_a_stage_starts_from_weights(settings, weights, tmp_path):
    frozen = ["experiment=stage2", "check_parent=stage", "schedule.stage2.learning_rate=0"]
    fit([*settings, *STEPS], tmp_path / "run", *frozen, f"init_from={weights}")
    content, parent = read_checkpoint(tmp_path / "run" / LAST), read_checkpoint(weights)
    assert content["parent"]["path"] == str(weights)
    assert (content["parent"]["stage"], content["parent"]["step"]) == ("stage1", 1)
    state = content["state_dict"]
    assert all(
        torch.equal(value, state[name])
        for name, value in parent["state_dict"].items()
        if name.endswith((".weight", ".bias"))
    )


def test_weights_are_no_run_to_resume(settings, weights, tmp_path):
    with pytest.raises(CheckpointError, match=r"no state of training: start a new run with init_from="):
        fit([*settings, *STEPS], tmp_path / "run", "experiment=stage1", f"resume={weights}")


def test_evaluate_takes_weights(settings, weights, tmp_path, monkeypatch):
    words = [*settings[:2], f"checkpoint={weights}", f"output={tmp_path / 'results'}"]
    typed = SimpleNamespace(overrides=SimpleNamespace(task=OmegaConf.create(words)))
    monkeypatch.setattr("raytran.run.evaluate.evaluate.HydraConfig", SimpleNamespace(get=lambda: typed))
    assert evaluate(compose("evaluate", words))["checkpoint"] == str(weights)
    assert json.loads((tmp_path / "results" / "metrics.json").read_text())["strict"]["n_scenes"] == 1


def test_predict_takes_weights(weights, rooms, tmp_path):
    scene = next((rooms / "scannet" / "scans").iterdir())
    words = [f"checkpoint={weights}", f"scene={scene}", f"output={tmp_path / 'room'}"]
    predict(compose("predict", [*words, "check=false", "num_views=3", "score_threshold=0.9"]))
    assert json.loads((tmp_path / "room" / "scene.json").read_text())["scene_id"] == scene.name
