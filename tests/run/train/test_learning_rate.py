# SPDX-License-Identifier: Apache-2.0
"""The search for a learning rate, by the command."""

from __future__ import annotations

import re

import pytest
import torch
from omegaconf import OmegaConf

from raytran.checkpoints.runs import LAST
from raytran.errors import ConfigError
from raytran.run.entry import compose
from raytran.run.train import learning_rate
from raytran.run.train.fit import train


@pytest.fixture(scope="module")
def settings(small_rooms):
    return [
        *("preset=tiny", f"data.root={small_rooms}", "trainer=cpu", "experiment=stage1", "progress_bar=none"),
        *("views.image_size=[32,32]", "views.num_views=2", "views.predict_views=2", "watch.pictures=0"),
        *("model.grid_resolution=[8,8,4]", "trainer.max_steps=2", "trainer.val_check_interval=2"),
    ]


def test_a_run_with_a_search_is_the_run_with_the_rate_it_finds(settings, tmp_path, command, monkeypatch):
    done = command("train", *settings, "lr_find=true", "output_dir=found", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    said = re.search(r"learning rate (\S+), found in (\d+) steps", done.stdout + done.stderr)
    rate = OmegaConf.load(tmp_path / "found" / "config.yaml").optimizer.learning_rate
    assert float(said[1]) == pytest.approx(rate, rel=0.01)
    assert int(said[2]) <= 100
    assert 1e-6 < rate < 1e-1
    default = compose("train", [*settings, "output_dir=none"]).optimizer.learning_rate
    assert rate != default
    assert (tmp_path / "found" / "learning_rate.png").stat().st_size > 1000
    assert {path.name for path in tmp_path.iterdir()} == {"found"}  # and no file of the search
    train(
        compose("train", [*settings, f"optimizer.learning_rate={rate!r}", f"output_dir={tmp_path / 'typed'}"])
    )
    found, typed = (torch.load(tmp_path / name / LAST, weights_only=True) for name in ("found", "typed"))
    assert all(torch.equal(found["state_dict"][name], value) for name, value in typed["state_dict"].items())
    assert found["optimizer_states"][0]["param_groups"][0]["initial_lr"] == rate

    # A resumed run keeps the rate, and does not search again.
    monkeypatch.setattr(learning_rate, "Tuner", None)
    more = ["lr_find=true", "resume=auto", "trainer.max_steps=3", f"output_dir={tmp_path / 'found'}"]
    assert train(compose("train", [*settings, *more])).steps == 3
    assert OmegaConf.load(tmp_path / "found" / "config.yaml").optimizer.learning_rate == rate


def test_one_device_searches(settings, tmp_path):
    several = ["trainer=ddp_cpu", "lr_find=true", f"output_dir={tmp_path / 'run'}"]
    with pytest.raises(ConfigError, match="lr_find=true searches on one device"):
        train(compose("train", [*settings, *several]))
