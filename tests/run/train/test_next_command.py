# SPDX-License-Identifier: Apache-2.0
"""A run that has ended names the command that goes on from it, and that command exists."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from raytran.run.entry import compose
from raytran.run.train.fit import FitResult
from raytran.run.train.next_command import tell_after_stage

RESULT = FitResult(Path("a b"), Path("a b/last.ckpt"), 3, 1.0, {})


@pytest.mark.parametrize(
    ("typed", "following"),
    [
        (["experiment=stage1"], "experiment=stage2 preset=tiny data=rooms data.root=data/rooms-tiny"),
        (
            ["experiment=stage2", "data=scan2cad", "data.root=my scans", "outputs=mine"],
            "experiment=stage3 preset=tiny data=scan2cad 'data.root=my scans' outputs=mine",
        ),
    ],
)
def test_the_next_stage_is_on_the_same_data(typed, following, caplog):
    caplog.set_level("INFO")
    tell_after_stage(compose("train", ["preset=tiny", "output_dir=x", *typed]), RESULT)
    (said,) = caplog.messages
    assert said.startswith("next: ")
    assert said.endswith(f"train {following}")
    compose("train", [*shlex.split(following), "output_dir=x"])


@pytest.mark.parametrize("experiment", ["stage3", "novel_view", "no_masks_stage2"])
def test_a_network_that_is_done_is_for_use(experiment, caplog):
    caplog.set_level("INFO")
    cfg = compose("train", ["preset=tiny", "output_dir=x", f"experiment={experiment}"])
    tell_after_stage(cfg, RESULT)
    (said,) = caplog.messages
    assert said.count("'checkpoint=a b/last.ckpt'") == 2
    assert "evaluate" in said
    assert "predict SCENE" in said
