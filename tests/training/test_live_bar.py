# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import logging

from rich.progress import TextColumn

from raytran.training.live_bar import LiveBar, is_terminal

from .screens import terminal


def test_what_is_logged_stands_on_a_line_of_its_own(monkeypatch):
    with terminal(monkeypatch) as (screen, handler):
        assert is_terminal()
        bar = LiveBar(TextColumn("{task.description}"))
        bar.add_task("the bar")
        bar.start()
        bar.refresh()
        begin = len(screen.getvalue())
        logging.getLogger("raytran").warning("stopping after this step")
        written = screen.getvalue()[begin:]
        bar.stop()
        # The bar is wiped, the message written where it stood, and the bar drawn below it.
        before, _, after = written.partition("stopping after this step\n")
        assert before.endswith("\x1b[2K"), repr(written)
        assert "the bar" in after
        assert handler.stream is screen
        logging.getLogger("raytran").warning("done")
        assert screen.getvalue().endswith("done\n")
