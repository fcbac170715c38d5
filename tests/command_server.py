# SPDX-License-Identifier: Apache-2.0
"""A process that has imported torch and Lightning and is forked for every command: see ``commands.py``.

A command that starts others (stages of a curriculum, jobs of a sweep, the ranks of Lightning) would import
all that in each of them. So before it does anything it forks spare processes, which are its own children as
those would be, and wherever it starts ``python -m raytran.…``, one of them becomes that.
"""

from __future__ import annotations

import atexit
import fcntl
import gc
import json
import os
import runpy
import socket
import subprocess
import sys
import threading
import traceback
from importlib import import_module
from inspect import signature

PARTS = ("train.fit", "train.curriculum", "evaluate.evaluate", "predict.predict", "export.export_model")
SPARES: list[tuple[int, socket.socket]] = []
"""Number of each spare process of this command, and where it hears what to be."""
SPARES_OF_STARTED = 1
"""What a started command may start in turn: one more rank."""
ABOVE = 100
"""No descriptor that a command is given has so high a number."""

execute_child = subprocess.Popen._execute_child


def serve() -> None:
    """Fork a command for a line that asks for one and say its number; or wait for one and say its code."""
    for part in PARTS:
        import_module(f"raytran.run.{part}")
    gc.collect()
    gc.freeze()  # what all commands share, their garbage collectors need not look at
    for line in sys.stdin:
        asked = json.loads(line)
        if "ended" in asked:
            answer = os.waitstatus_to_exitcode(os.waitpid(asked["ended"], 0)[1])
        elif (answer := os.fork()) == 0:
            for number, path in enumerate((os.devnull, asked["stdout"], asked["stderr"])):
                os.dup2(os.open(path, os.O_RDWR), number)
            run(asked)
        sys.stdout.write(f"{answer}\n")
        sys.stdout.flush()


def run(asked: dict) -> None:
    """Be the command, and end with it."""
    os.chdir(asked["folder"])
    os.environ.clear()
    os.environ.update(asked["environment"])
    for _ in range(asked["starts"]):
        if (started := spare()) is not None:
            run(started)
    rank_zero = import_module("lightning.fabric.utilities.rank_zero")
    rank_zero.rank_zero_only.rank = rank_zero._get_rank() or 0  # which its import has read before
    subprocess.Popen._execute_child = execute_child_or_hand_over
    sys.argv = ["", *asked["arguments"]]
    sys.path[:0] = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    code = 0
    try:
        exec(asked["first"], {})
        if asked["module"].endswith(".py"):
            runpy.run_path(asked["module"], run_name="__main__")
        else:
            runpy.run_module(asked["module"], run_name="__main__", alter_sys=True)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    # What Python does at its end, but for taking apart a million objects, longer than most commands.
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def spare() -> dict | None:
    """Fork a process that waits; in it return what it is to be, once it hears that."""
    here, there = socket.socketpair()
    number = os.fork()
    if number:
        there.close()
        SPARES.append((number, here))
        return None
    here.close()
    for _, other in SPARES:
        other.close()
    SPARES.clear()
    _, given, _, _ = socket.recv_fds(there, 1, 16)
    with there, there.makefile() as told:
        line = told.readline()
    if not line:
        os._exit(0)  # the command has ended and not needed it
    asked = json.loads(line)
    kept = [fcntl.fcntl(descriptor, fcntl.F_DUPFD, ABOVE) for descriptor in given]
    for descriptor, wanted in zip(kept, asked["descriptors"], strict=True):
        os.dup2(descriptor, wanted)
        os.close(descriptor)
    # Under the numbers they came with, a command that is started does not have them.
    for descriptor in set(given) - set(asked["descriptors"]):
        os.close(descriptor)
    if asked["session"]:
        os.setsid()
    return asked


def execute_child_or_hand_over(process: subprocess.Popen, *arguments: object) -> None:
    """Do what ``Popen`` does to start a process; where that is a command of raytran, a spare becomes it."""
    asked = signature(execute_child).bind(process, *arguments).arguments
    words = [os.fspath(word) for word in asked["args"]]
    if not SPARES or words[:2] != [sys.executable, "-m"] or not words[2].startswith("raytran."):
        execute_child(process, *arguments)
        return
    process.pid, there = SPARES.pop()
    pipes = asked["p2cread"], asked["c2pwrite"], asked["errwrite"]
    descriptors = {number: number if pipe == -1 else pipe for number, pipe in enumerate(pipes)}
    descriptors |= {number: number for number in asked["pass_fds"]}
    told = {
        "module": words[2],
        "arguments": words[3:],
        "folder": os.path.join(os.getcwd(), asked["cwd"] or ""),
        "environment": dict(os.environ if asked["env"] is None else asked["env"]),
        "descriptors": list(descriptors),
        "session": asked["start_new_session"],
        "starts": SPARES_OF_STARTED,
        "first": "",
    }
    socket.send_fds(there, [b"!"], list(descriptors.values()))
    there.sendall(json.dumps(told).encode() + b"\n")
    there.close()
    process._child_created = True
    ours = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
    process._close_pipe_fds(*(asked[name] for name in ours))


if __name__ == "__main__":
    sys.path[0] = ""  # and not the folder of this file
    serve()
