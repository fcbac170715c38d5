# SPDX-License-Identifier: Apache-2.0
"""The table of a run's metrics: one CSV file for the whole run, however often it was stopped."""

from __future__ import annotations

import csv
import io
import logging
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from raytran.data.files import write_text

_log = logging.getLogger(__name__)


class MetricsTable(Logger):
    """Appends a row for each logging; a resumed run goes on in the same file, without rows that come twice.

    (Lightning's own logger starts another file then, or deletes the one that is there.)

    Args:
        path: the file. Its first columns are ``step`` and ``epoch``.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__()
        self.path = Path(path)
        self._columns = ["step", "epoch"]
        self._waiting: list[dict[str, Any]] = []
        self._failed = False

    @property
    def name(self) -> str:
        """Return the name of the file without its ending."""
        return self.path.stem

    @property
    def version(self) -> int:
        """Return 0: there is one table."""
        return 0

    @property
    def save_dir(self) -> str:
        """Return the folder of the file."""
        return str(self.path.parent)

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, Any], step: int | None = None) -> None:
        """Add a row; ``save`` writes it."""
        self._waiting.append({**metrics, "step": step})

    @rank_zero_only
    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        """Do nothing: ``config.yaml`` holds the settings."""

    @rank_zero_only
    def save(self) -> None:
        """Write the rows that wait; on a full disk they wait on."""
        if not self._waiting:
            return
        known = set(self._columns)
        new = sorted({name for row in self._waiting for name in row} - known)
        try:
            if new or not self.path.is_file():
                rows = [*self._read(), *self._waiting]
                self._columns += new
                self._rewrite(rows)
            else:
                with self.path.open("a", newline="", encoding="utf-8") as file:
                    writer = csv.DictWriter(file, self._columns, lineterminator="\n")
                    writer.writerows(self._waiting)
        except OSError as error:
            if not self._failed:
                reason = error.strerror
                _log.warning("cannot write %s (%s): make room there; training goes on", self.path, reason)
            self._failed = True
            return
        self._failed = False
        self._waiting.clear()

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Write the rows that wait."""
        self.save()

    @rank_zero_only
    def continue_from(self, step: int) -> None:
        """Forget what was logged at ``step`` and later: the run does these steps again."""
        if not self.path.is_file():
            return
        rows = [row for row in self._read() if int(row["step"]) < step]
        self._rewrite(rows)

    def _read(self) -> list[dict[str, Any]]:
        """Return the rows of the file, but for a last line that a kill cut short; take over its columns."""
        if not self.path.is_file():
            return []
        lines = self.path.read_text(encoding="utf-8").splitlines(keepends=True)
        rows = csv.DictReader(line for line in lines if line.endswith("\n"))
        self._columns = list(rows.fieldnames or self._columns)
        return list(rows)

    def _rewrite(self, rows: list[dict[str, Any]]) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, self._columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text(self.path, text.getvalue())


def read_table(path: Path) -> dict[str, list[tuple[int, float]]]:
    """Return what a table holds: name → (step, value) pairs by rising step."""
    if not path.is_file():
        return {}
    history: dict[str, dict[int, float]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            for name, value in row.items():
                if name not in ("step", "epoch") and value:
                    history.setdefault(name, {})[int(row["step"])] = float(value)
    return {name: sorted(values.items()) for name, values in history.items()}
