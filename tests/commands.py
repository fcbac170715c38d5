# SPDX-License-Identifier: Apache-2.0
"""Commands of raytran in processes of their own that need not import torch and Lightning first.

``raytran train`` takes six seconds of a core before it does anything. ``Commands`` imports all that
once, in a process that does nothing else (``command_server.py``), and forks it for every command.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

SERVER = Path(__file__).with_name("command_server.py")


@dataclass
class Started:
    """A command that runs.

    Attributes:
        pid: number of its process.
        asked: what was to be run.
        streams: files of what it writes to stdout and stderr.
        ended: waits for the process of a number and returns its exit code.
    """

    pid: int
    asked: dict[str, Any]
    streams: tuple[IO[str], IO[str]]
    ended: Callable[[int], int]

    def wait(self) -> subprocess.CompletedProcess[str]:
        """Return its exit code and what it wrote, once it has ended."""
        code = self.ended(self.pid)
        written = []
        for stream in self.streams:
            with stream:
                written.append(stream.read())
        return subprocess.CompletedProcess([self.asked["module"], *self.asked["arguments"]], code, *written)


class Commands:
    """Runs ``python -m raytran.<name> …``; close it when there are no more to run."""

    def __init__(self) -> None:
        self._server = subprocess.Popen(
            [sys.executable, SERVER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )

    def __call__(self, *words: str, **settings: Any) -> subprocess.CompletedProcess[str]:
        """Run a command, given as for ``start``, and return its exit code and what it wrote."""
        return self.start(*words, **settings).wait()

    def start(
        self, name: str, *arguments: str, folder: Path, first: str = "", starts: int = 0, **environment: str
    ) -> Started:
        """Start a command in ``folder``.

        Args:
            name: of the command; or the path of a file, run as ``python <file>``.
            arguments: as typed.
            folder: where.
            first: Python to execute in its process before it.
            starts: how many commands of raytran it will start, and each of them one more; beyond these they
                import torch anew.
            environment: variables besides those of the tests.
        """
        out, err = (tempfile.NamedTemporaryFile("r+", encoding="utf-8") for _ in range(2))  # noqa: SIM115
        asked = {
            "module": name if name.endswith(".py") else f"raytran.{name}",
            "arguments": [str(word) for word in arguments],
            "folder": str(folder),
            "environment": os.environ | {"OMP_NUM_THREADS": "1"} | environment,
            "first": first,
            "starts": starts,
            "stdout": out.name,
            "stderr": err.name,
        }
        pid = self._say(dict(asked))
        return Started(pid, asked, (out, err), lambda pid: self._say({"ended": pid}))

    def _say(self, words: dict[str, Any]) -> int:
        self._server.stdin.write(f"{json.dumps(words)}\n")
        self._server.stdin.flush()
        return int(self._server.stdout.readline())

    def close(self) -> None:
        """End the process that is forked."""
        self._server.communicate()
