# SPDX-License-Identifier: Apache-2.0
"""The demo runs from nothing to a page, goes on where it was, and keeps to its settings."""

from __future__ import annotations

import json

import pytest
from omegaconf import OmegaConf

from raytran.checkpoints.file import shipped_weights, write_checkpoint
from raytran.checkpoints.metadata import checkpoint_metadata
from raytran.checkpoints.runs import read_finished
from raytran.data.locks import exclusive_lock
from raytran.errors import ConfigError
from raytran.run.demo.demo import _asked, demo
from raytran.run.entry import compose
from raytran.run.train.build import build_data, build_model, plain

FEW = [
    "rooms.num_train=1",
    "rooms.num_val=1",
    "rooms.frames=6",
    "rooms.image_size=[60,80]",
    "rooms.max_objects=4",
    "rooms.processes=1",
    "views.image_size=[48,64]",
    "views.num_views=2",
    "views.predict_views=3",
    "schedule.stage1.steps=2",
    "schedule.stage2.steps=2",
    "schedule.stage3.steps=2",
    "schedule.log_every=1",
    "progress_bar=none",
]


OWN = ["validate_every=1", "learned.stage1=0.0", "learned.stage3=null"]


def run(output, *more):
    """Run the demo as the command line does."""
    typed = [f"output={output}", "preset=tiny", *OWN, *FEW, *more]
    return demo(compose("demo", typed), typed)


def test_a_network_of_ones_own_is_trusted_because_it_was_typed(tmp_path, mylab):
    typed = [
        *FEW,
        "preset=tiny",
        "model.backbone._target_=mylab.MyBackbone",
        f"data.root={tmp_path / 'rooms'}",
    ]
    cfg = compose("train", [*typed, "experiment=stage3", "output_dir=unused"])
    metadata = checkpoint_metadata(stage="stage3", preset="tiny", config=plain(cfg), parent=None)
    state = {f"model.{name}": value for name, value in build_model(cfg).state_dict().items()}
    write_checkpoint(tmp_path / "last.ckpt", {**metadata, "state_dict": state})
    asked = _asked(typed, build_data(cfg), tmp_path / "last.ckpt")
    assert type(asked["train"].model.backbone).__module__ == "mylab.nets"


def test_two_demos_in_one_folder(tmp_path):
    output = tmp_path / "demo"
    with (
        exclusive_lock(output / ".demo.lock", if_taken=ConfigError),
        pytest.raises(ConfigError, match=r"another process makes the demo in .*demo \(number"),
    ):
        run(output)


@pytest.mark.parametrize(
    ("typed", "preset", "steps"),
    [((), "tiny", 600), (("preset=laptop",), "laptop", 9000), (("schedule.stage2.steps=7",), "tiny", 7)],
)
def test_settings_of_a_training_can_be_typed(tmp_path, command, typed, preset, steps):
    shown = command("demo", *typed, "--cfg", "job", folder=tmp_path)
    assert shown.returncode == 0, shown.stderr
    cfg = OmegaConf.create(shown.stdout)
    assert (cfg.preset, cfg.schedule.stage2.steps) == (preset, steps)


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (["preset=lapto"], "there is no preset=lapto: is preset=laptop meant?"),
        (["preset=laptop", "nope=1"], "there is no setting nope"),
        (["preset=laptop", "experiment=stage1"], "the demo decides experiment= itself"),
        (["data.root=rooms"], "the demo decides data.root= itself"),
    ],
)
def test_what_a_demo_does_not_take_is_one_sentence(tmp_path, command, typed, said):
    done = command("demo", *typed, folder=tmp_path)
    assert done.returncode == 1
    (sentence,) = done.stderr.splitlines()
    assert said in sentence
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_demo_from_nothing_to_a_page_and_again(tmp_path, caplog, capsys):
    caplog.set_level("INFO")
    output = tmp_path / "demo"
    first = run(output)
    assert list(first.metrics) == ["train", "val", "shipped"][: 2 if shipped_weights() is None else 3]
    assert first.page.read_text().count("<figure") == len(first.metrics) * 5 + 1
    assert str(first.page) in capsys.readouterr().out.replace("\n", "")
    checkpoint = output / "training" / "stage3" / "checkpoints" / "last.ckpt"
    trained = checkpoint.stat().st_mtime_ns
    for split, scene in (("train", "scene0000_00"), ("val", "scene0001_00")):
        written = json.loads((output / "evaluation" / split / "metrics.json").read_text())
        assert written["strict"] == first.metrics[split]["strict"]
        assert json.loads((output / "predictions" / scene / "scene.json").read_text())["scene_id"] == scene
    steps = {
        stage: read_finished(output / "training" / stage).steps for stage in ("stage1", "stage2", "stage3")
    }
    assert steps == {"stage1": 1, "stage2": 2, "stage3": 2}, "a stage ends when its rooms are learned"
    assert first.metrics["train"]["strict"]["n_scenes"] == 1
    assert set(first.seconds) >= {"rooms", "training, stage1", "training, stage3", "evaluation", "prediction"}

    again = run(output)
    assert checkpoint.stat().st_mtime_ns == trained, "finished stages are not trained again"
    assert again.metrics == first.metrics
    assert again.seconds["training, stage1"] == first.seconds["training, stage1"]
    assert "finished already" in caplog.text

    with pytest.raises(ConfigError, match="other settings"):
        run(output, "schedule.stage1.learning_rate=1e-4")
    with pytest.raises(ConfigError, match="other settings"):
        run(output, "learned.stage2=0.5")
