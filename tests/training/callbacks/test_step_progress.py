# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import lightning.pytorch as pl
import pytest

from raytran.training.callbacks.step_progress import StepProgress

from ..screens import terminal


class Fails(pl.Callback):
    def on_train_batch_start(self, trainer, *_):
        if trainer.global_step == 2:
            raise ValueError("of the test")


def test_without_a_terminal_there_are_ten_lines(fit, caplog):
    caplog.set_level("INFO", "raytran")
    fit(StepProgress("stage1"), experiment="stage1", max_steps=20)
    lines = [record.message for record in caplog.records if record.message.startswith("stage1: step ")]
    assert len(lines) == 10
    assert lines[0].startswith("stage1: step 2 of 20, loss ")


def test_a_run_that_fails_leaves_the_terminal_as_it_was(fit, monkeypatch):
    with terminal(monkeypatch) as (screen, handler):
        with pytest.raises(ValueError, match="of the test"):
            fit(StepProgress("stage1"), Fails(), experiment="stage1", max_steps=4)
        assert handler.stream is screen
        shown, hidden = "\x1b[?25h", "\x1b[?25l"
        assert screen.getvalue().count(shown) == screen.getvalue().count(hidden) == 1, "the cursor"
        assert "2/4" in screen.getvalue()
