# SPDX-License-Identifier: Apache-2.0
"""A terminal whose screen a test can read."""

from __future__ import annotations

import io
import logging
import sys
from contextlib import contextmanager


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
