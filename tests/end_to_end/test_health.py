# SPDX-License-Identifier: Apache-2.0
"""A run on two ranks that loses itself: it gives up, says so, and its last step can be done again."""

from __future__ import annotations

import pytest
import torch
from omegaconf import OmegaConf

from raytran.checkpoints.file import read_checkpoint
from raytran.checkpoints.runs import LAST
from raytran.errors import CheckpointError, ConfigError
from raytran.run.entry import compose
from raytran.run.replay import _parts, replay
from raytran.run.train.build import build_model, plain


@pytest.fixture(scope="module")
def lost(settings, tmp_path_factory, command):
    """The folder of the run and what the command said; its first step makes weights as large as 1e29."""
    folder = tmp_path_factory.mktemp("lost")
    arguments = [
        *(item for item in settings if item != "trainer=cpu"),
        "trainer=ddp_cpu",
        "views.batch_size=1",
        "optimizer.learning_rate=1e30",
        "watch.max_skipped=3",
        "trainer.max_steps=20",
        f"output_dir={folder / 'run'}",
    ]
    return folder / "run", command("train", *arguments, folder=folder)


def test_it_gives_up_in_one_sentence(lost):
    folder, done = lost
    assert done.returncode == 1
    said = [line for line in done.stderr.splitlines() if line.startswith("raytran: ")]
    assert len(said) == 1, done.stderr
    assert "3 steps in a row were not finite, the last one step 3 (the loss (occupancy))" in said[0]
    assert f"python -m raytran.replay {folder / 'replay.pt'}" in said[0]
    assert (folder / "replay-1.pt").is_file()


def test_what_was_saved_is_finite(lost):
    folder, _ = lost
    for path in (folder / LAST, folder / "replay.pt", folder / "replay-1.pt"):
        assert all(value.isfinite().all() for value in read_checkpoint(path)["state_dict"].values()), path


def test_the_step_can_be_done_again(lost, capsys):
    folder, _ = lost
    found = replay(compose("replay", [f"file={folder / 'replay.pt'}", "device=cpu"]))
    assert found.parts[0].startswith("backbone.")
    assert not torch.tensor(found.losses["total"]).isfinite()
    said = capsys.readouterr().out
    assert "step 3 of stage1" in said
    assert f"not finite in the forward pass, in order: {found.parts[0]}" in said


def test_gradients_overflow_again_by_the_scale_of_the_loss(lost, tmp_path, capsys):
    folder, _ = lost
    content = read_checkpoint(folder / "replay.pt")
    torch.manual_seed(0)
    fresh = build_model(OmegaConf.create(content["config"]), pretrained=False).state_dict()
    content["state_dict"] = {f"model.{name}": value for name, value in fresh.items()}
    content["replay"] |= {"precision": "16-mixed", "scale": 2.0**40}
    path = tmp_path / "replay.pt"
    torch.save(content, path)
    found = replay(compose("replay", [f"file={path}", "device=cpu"]))
    assert not found.parts
    assert found.gradients
    assert "16-mixed on cpu, loss times 1.09951e+12" in capsys.readouterr().out
    assert not replay(compose("replay", [f"file={path}", "device=cpu", "precision=32-true"])).gradients
    content["replay"]["scale"] = None
    torch.save(content, path)
    assert not replay(compose("replay", [f"file={path}", "device=cpu"])).gradients


def test_a_checkpoint_is_no_replay(lost):
    folder, _ = lost
    with pytest.raises(CheckpointError, match="is a checkpoint without batches"):
        replay(compose("replay", [f"file={folder / LAST}"]))


@pytest.mark.parametrize(
    ("key", "target"), [("loss", "os.system"), ("stage", "raytran.training.stage.Other"), ("loss", None)]
)
def test_a_strangers_loss_is_not_run(key, target, lost, tmp_path):
    folder, _ = lost
    content = read_checkpoint(folder / "replay.pt")
    content["config"][key]["_target_"] = target
    torch.save(content, tmp_path / "replay.pt")
    with pytest.raises(CheckpointError, match="a stage or a loss of another kind"):
        replay(compose("replay", [f"file={tmp_path / 'replay.pt'}", "device=cpu"]))


def test_the_loss_is_that_of_the_run(lost, tmp_path):
    """With every choice it had; one from before a choice could be made has what was done then."""
    folder, _ = lost
    content = read_checkpoint(folder / "replay.pt")
    stage = plain(compose("train", ["experiment=stage2", "output_dir=unused"]).stage)
    content["config"]["stage"] = stage
    loss = content["config"]["loss"]
    _, total, _ = _parts(content, folder, ())
    assert (total.shape_layers, total.betas, total.matcher.class_cost) == ("last", (0.1, 0.1), "probability")
    loss |= {"shape_layers": "all", "center_beta": 0.4}
    loss["matcher"] |= {"class_cost": "cross_entropy", "yaw_beta": 0.3}
    _, total, _ = _parts(content, folder, ())
    assert (total.shape_layers, total.betas) == ("all", (0.4, 0.1))
    assert (total.matcher.class_cost, total.matcher.betas) == ("cross_entropy", (0.1, 0.3))
    for name in ("shape_layers", "center_beta", "yaw_beta"):
        del loss[name]
    for name in ("class_cost", "center_beta", "yaw_beta"):
        del loss["matcher"][name]
    _, total, _ = _parts(content, folder, ())
    assert (total.shape_layers, total.betas, total.matcher.class_cost) == ("last", (0.1, 0.1), "probability")


def test_a_network_of_ones_own_is_done_again_if_it_is_trusted(lost, tmp_path, monkeypatch):
    folder, _ = lost
    (tmp_path / "replayed_lab.py").write_text(
        "from raytran.backbone.backbone import Backbone as B\nclass Own(B): pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    content = read_checkpoint(folder / "replay.pt")
    content["model"]["backbone"]["_target_"] = "replayed_lab.Own"
    torch.save(content, tmp_path / "replay.pt")
    settings = [f"file={tmp_path / 'replay.pt'}", "device=cpu"]
    with pytest.raises(CheckpointError, match=r"no network of raytran.* give trust=\[replayed_lab\]"):
        replay(compose("replay", settings))
    assert replay(compose("replay", [*settings, "trust=[replayed_lab]"])).parts[0].startswith("backbone.")


def test_an_unknown_precision_is_one_sentence(lost):
    folder, _ = lost
    with pytest.raises(ConfigError, match="unknown precision=8: choose one of 32-true, bf16-mixed, 16-mixed"):
        replay(compose("replay", [f"file={folder / 'replay.pt'}", "precision=8"]))
