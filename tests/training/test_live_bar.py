# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
import logging
import sys
from contextlib import contextmanager

from rich.progress import TextColumn

from raytran.training.live_bar import LiveBar, is_terminal


class Terminal(io.StringIO):
    def isatty(self):
        return True


@contextmanager
def terminal(monkeypatch):
    """Give a terminal on which the log writes too, and the log's handler."""
    screen = Terminal()
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setenv("TERM", "xterm")
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(name, raising=False)
    handler = logging.StreamHandler(screen)
    log = logging.getLogger()
    log.addHandler(handler)
    yield screen, handler
    log.removeHandler(handler)


def test_what_is_logged_stands_on_a_line_of_its_own(monkeypatch):
    with terminal(monkeypatch) as (screen, handler):
        check(screen, handler)


def check(screen, handler):
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
