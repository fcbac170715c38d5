# SPDX-License-Identifier: Apache-2.0
"""Commands of raytran in processes of their own that need not import torch and Lightning first.

``python -m raytran.train`` takes six seconds of a core before it does anything. ``Commands`` imports all that
once, in a process that does nothing else, and forks it for every command.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

SERVER = """
import atexit, json, os, runpy, sys, threading, traceback
from importlib import import_module

for name in ("train.fit", "train.curriculum", "evaluate.evaluate", "predict.predict", "export.export_model"):
    import_module(f"raytran.run.{name}")
for line in sys.stdin:
    asked = json.loads(line)
    child = os.fork()
    if child == 0:
        for number, path in enumerate((os.devnull, asked["stdout"], asked["stderr"])):
            os.dup2(os.open(path, os.O_RDWR), number)
        os.chdir(asked["folder"])
        os.environ.clear()
        os.environ.update(asked["environment"])
        sys.argv = ["", *asked["arguments"]]
        break
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
else:
    sys.exit()
sys.path[:0] = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
code = 0
try:
    exec(asked["first"], {})
    runpy.run_module(asked["module"], run_name="__main__", alter_sys=True)
except SystemExit as stop:
    code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
except BaseException:
    traceback.print_exc()
    code = 1
# What Python does at its end, but for taking apart a million objects, which takes longer than most commands.
threading._shutdown()
atexit._run_exitfuncs()
sys.stdout.flush()
sys.stderr.flush()
os._exit(code)
"""


class Commands:
    """Runs ``python -m raytran.<name> …``; close it when there are no more to run."""

    def __init__(self) -> None:
        self._server = subprocess.Popen(
            [sys.executable, "-c", SERVER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )

    def __call__(
        self, name: str, *arguments: str, folder: Path, first: str = "", **environment: str
    ) -> subprocess.CompletedProcess[str]:
        """Run a command in ``folder`` and return its exit code and what it wrote.

        Args:
            name: of the command.
            arguments: as typed.
            folder: where.
            first: Python to execute in its process before it.
            environment: variables besides those of the tests.
        """
        with (
            tempfile.NamedTemporaryFile("r+", encoding="utf-8") as out,
            tempfile.NamedTemporaryFile("r+", encoding="utf-8") as err,
        ):
            asked = {
                "module": f"raytran.{name}",
                "arguments": [str(word) for word in arguments],
                "folder": str(folder),
                "environment": os.environ | {"OMP_NUM_THREADS": "1"} | environment,
                "first": first,
                "stdout": out.name,
                "stderr": err.name,
            }
            self._server.stdin.write(f"{json.dumps(dict(asked))}\n")
            self._server.stdin.flush()
            code = int(self._server.stdout.readline())
            return subprocess.CompletedProcess([asked["module"], *arguments], code, out.read(), err.read())

    def close(self) -> None:
        """End the process that is forked."""
        self._server.communicate()
