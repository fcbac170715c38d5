# SPDX-License-Identifier: Apache-2.0
"""A progress bar that stays below what is logged meanwhile."""

from __future__ import annotations

import logging
import sys
from typing import Any

from rich.console import Console
from rich.progress import Progress, ProgressColumn


def is_terminal() -> bool:
    """Return whether there is a terminal to draw a bar on."""
    return Console().is_terminal


class LiveBar(Progress):
    """A rich bar at the bottom of a terminal, above which log lines appear, each on a line of its own.

    rich does this for what is written to ``sys.stdout``; handlers of the log have taken the stream itself
    when they were made, and would write behind the bar.
    """

    def __init__(self, *columns: ProgressColumn) -> None:
        # Not rich's own console, which keeps what it was told of the terminal when it was first asked for.
        super().__init__(*columns, console=Console(), refresh_per_second=4)
        self._redirected: list[tuple[logging.StreamHandler[Any], Any]] = []

    def start(self) -> None:
        """Draw the bar and let the log write above it."""
        streams = (sys.stdout, sys.stderr)
        super().start()
        for handler in logging.getLogger().handlers:
            if isinstance(handler, logging.StreamHandler) and handler.stream in streams:
                self._redirected.append((handler, handler.stream))
                handler.setStream(sys.stdout)

    def stop(self) -> None:
        """Leave the bar on the screen as it is, and give the log its streams back."""
        while self._redirected:
            handler, stream = self._redirected.pop()
            handler.setStream(stream)
        super().stop()
