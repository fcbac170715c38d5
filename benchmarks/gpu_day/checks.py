# SPDX-License-Identifier: Apache-2.0
"""What a part finds, written down line by line, so that a process that dies takes nothing with it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from device import Device
from timing import reason

Verdict = Literal["pass", "FAIL", "not measured", "reported"]
"""``reported``: a figure without a bar."""


@dataclass(frozen=True)
class Check:
    """One line of the report.

    Attributes:
        name: what was looked at.
        bar: what it should be; "" for a figure that is only reported.
        measured: what it is, in words.
        verdict: whether it is.
        why: the reason of a failure or of what was not measured.
        notes: lines for those who want to know more.
    """

    name: str
    bar: str
    measured: str
    verdict: Verdict
    why: str = ""
    notes: Sequence[str] = field(default=())


class Checks:
    """Appends checks to a file, each a line of JSON.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def add(
        self,
        name: str,
        *,
        measured: str = "–",
        bar: str = "",
        passed: bool | None = None,
        why: str = "",
        notes: Sequence[str] = (),
    ) -> None:
        """Write a check; without ``passed`` it is a figure, or was not measured if ``why`` says so."""
        if passed is None:
            verdict: Verdict = "not measured" if why else "reported"
        else:
            verdict = "pass" if passed else "FAIL"
        self._write({"check": asdict(Check(name, bar, measured, verdict, why, tuple(notes)))})

    def measured(
        self,
        device: Device,
        name: str,
        value: float | None,
        text: Callable[[float], str],
        *,
        bar: str = "",
        good: Callable[[float], bool] | None = None,
        why: str = "",
    ) -> None:
        """Write a figure of time or memory, which only a GPU has.

        Args:
            device: that it was taken on.
            name: what it is.
            value: the figure; None if there is none, for the reason ``why``.
            text: the figure in words.
            bar: what it should be.
            good: whether it is; None for a figure without a bar.
            why: why there is none.
        """
        if device.why_unmeasured or value is None:
            self.add(name, bar=bar, why=device.why_unmeasured or why or "there is no such figure here")
        else:
            self.add(name, bar=bar, measured=text(value), passed=None if good is None else good(value))

    @contextmanager
    def attempt(self, name: str, bar: str = "") -> Iterator[None]:
        """Make of an exception a failed check of this name, and go on."""
        try:
            yield
        except Exception as error:  # whatever it is, the other checks shall run
            self.add(name, bar=bar, passed=False, why=reason(error))

    def machine(self, about: dict[str, Any]) -> None:
        """Write what all figures depend on."""
        self._write({"machine": about})

    def seconds(self, taken: float) -> None:
        """Write how long it took."""
        self._write({"seconds": taken})

    def _write(self, entry: dict[str, Any]) -> None:
        with self._path.open("a", encoding="utf-8") as file:
            # An empty line, which ends one that a process that died may have left unfinished.
            file.write(f"\n{json.dumps(entry)}\n")


def read_entries(path: Path) -> list[dict[str, Any]]:
    """Return what was written, but for lines that were cut short; nothing if there is no file."""
    entries = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        with suppress(json.JSONDecodeError):
            entries.append(json.loads(line))
    return entries
