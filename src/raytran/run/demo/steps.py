# SPDX-License-Identifier: Apache-2.0
"""How long each step of a longer piece of work took, remembered over kills."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from raytran.data.files import write_json

_log = logging.getLogger(__name__)


class StepTimes:
    """Seconds per step, in the order of their first appearance, kept in a file.

    Args:
        path: JSON file; what it holds is read first.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self.seconds: dict[str, float] = json.loads(path.read_text())
        except (OSError, ValueError):
            # Times are told, nothing depends on them.
            self.seconds = {}

    @contextmanager
    def measure(self, name: str, *, continues: bool = False) -> Iterator[None]:
        """Time a block and say so in the log.

        Args:
            name: of the step.
            continues: the step goes on where a killed run left it, so times add up; else the last one counts.
        """
        _log.info("%s …", name)
        began = time.monotonic()
        try:
            yield
        finally:
            self.add(name, time.monotonic() - began, continues=continues)
        _log.info("%s: %.1f s", name, self.seconds[name])

    def add(self, name: str, seconds: float, *, continues: bool = False) -> None:
        """Enter the time of a step that was measured elsewhere."""
        self.seconds[name] = seconds + (self.seconds.get(name, 0.0) if continues else 0.0)
        write_json(self._path, self.seconds)
