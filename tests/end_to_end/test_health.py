# SPDX-License-Identifier: Apache-2.0
"""A run on two ranks whose numbers stop being finite: it gives up and says so in one sentence."""

from __future__ import annotations

import pytest

from raytran.checkpoints.file import read_checkpoint
from raytran.checkpoints.runs import LAST


@pytest.fixture(scope="module")
def lost(settings, tmp_path_factory, command):
    """The folder of the run and what the command said; its first step makes weights as large as 1e29."""
    folder = tmp_path_factory.mktemp("lost")
    arguments = [
        *(item for item in settings if item != "trainer=cpu"),
        "trainer=ddp_cpu",
        "views.batch_size=1",
        "optimizer.learning_rate=1e6",
        "watch.max_skipped=3",
        "trainer.max_steps=20",
        f"output_dir={folder / 'run'}",
    ]
    return folder / "run", command("train", *arguments, folder=folder, starts=1)


def test_it_gives_up_in_one_sentence(lost):
    _, done = lost
    assert done.returncode == 1
    said = [line for line in done.stderr.splitlines() if line.startswith("raytran: ")]
    assert len(said) == 1, done.stderr
    assert "3 steps in a row were not finite, the last one step 3 (the" in said[0]


def test_what_was_saved_is_finite(lost):
    folder, _ = lost
    assert all(value.isfinite().all() for value in read_checkpoint(folder / LAST)["state_dict"].values())
