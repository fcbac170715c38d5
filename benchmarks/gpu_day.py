# SPDX-License-Identifier: Apache-2.0
"""The first thing to do on a machine with GPUs: ``python benchmarks/gpu_day.py --output DIR``.

Is raytran right there, does it train, is it fast? Five parts answer. ``DIR/report.md`` and ``report.json``,
written anew after every step, have a line for each check: its bar, what was measured, and pass or fail.

1. environment: versions, drivers, shared memory, how the GPUs are joined;
2. kernels: against the dense twin in float64, on the second GPU too; the whole network against the CPU;
3. waits: of the host in a training step; launches; memory errors of the kernels, by compute-sanitizer;
4. training: by the commands, to a known loss and score, killed and resumed; one GPU against all of them;
5. bars: of speed and memory.

Each step is a process of its own with a limit of time, so that none that fails, crashes or hangs stops
another. The exit code is 1 if a check failed. Reckoned, not measured: ten minutes on one GPU with 16 cores.
``--parts kernels bars`` does some parts again; what the others left in the folder stays in the report.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import torch
from gpu_day.checks import Check, Checks, read_entries
from gpu_day.report import Part, failures, write_report

PARTS = {
    "environment": "Environment",
    "kernels": "Kernels and network against what is known to be right",
    "waits": "Waits, launches and memory errors",
    "training": "Training by the commands",
    "bars": "Bars of speed and memory",
}


class Step(NamedTuple):
    """A piece of a part that runs in a process of its own.

    Attributes:
        part: that it belongs to.
        function: what it does, ``module.function`` of the folder ``gpu_day``.
        limit: seconds after which it is stopped.
    """

    part: str
    function: str
    limit: float


STEPS = {
    "environment": Step("environment", "environment.examine", 120),
    "operators": Step("kernels", "kernels.operators", 240),
    "operators-cuda1": Step("kernels", "kernels.operators_elsewhere", 240),
    "small-networks": Step("kernels", "network.small_networks", 240),
    "whole-network": Step("kernels", "network.whole_network", 300),
    "steps": Step("waits", "waits.training_steps", 240),
    "memory-errors": Step("waits", "waits.memory_errors", 300),
    "commands": Step("training", "training.commands", 480),
    "ranks": Step("training", "training.several_gpus", 240),
    "traversal": Step("bars", "bars.traversal", 60),
    "attention-to-voxels": Step("bars", "bars.attention_to_voxels", 180),
    "attention-to-pixels": Step("bars", "bars.attention_to_pixels", 180),
    "attention-memory": Step("bars", "bars.attention_memory", 120),
    "training-step": Step("bars", "bars.training_step", 180),
    "prediction": Step("bars", "bars.prediction", 180),
    "several-gpus": Step("bars", "bars.several_gpus", 180),
    "boxes": Step("bars", "bars.boxes", 120),
}


def main() -> None:
    """Run the steps one after another; exit with 1 if a check failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--output", type=Path, required=True, help="folder for the report and what it comes from"
    )
    parser.add_argument(
        "--parts", nargs="+", choices=tuple(PARTS), default=tuple(PARTS), help="all without it"
    )
    # For the test of this file: on a device that is none, at small sizes, all steps in one process.
    parser.add_argument("--device", choices=("cuda", "pretend"), default="cuda", help=argparse.SUPPRESS)
    parser.add_argument("--steps", nargs="+", choices=tuple(STEPS), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    folder = arguments.output.resolve()
    if arguments.steps:
        run_here(arguments.steps, folder, arguments.device)
        return
    if arguments.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("gpu_day.py needs an NVIDIA GPU that this torch can use, and finds none here")
    folder.mkdir(parents=True, exist_ok=True)
    failed = run_parts(arguments.parts, folder, arguments.device)
    print(
        f"wrote {folder / 'report.md'}: {'nothing failed' if not failed else f'{len(failed)} checks failed'}"
    )
    raise SystemExit(1 if failed else 0)


def run_parts(names: Sequence[str], folder: Path, device: str) -> list[Check]:
    """Run the steps of some parts, each in a process of its own; return the checks that failed."""
    chosen = [name for name, step in STEPS.items() if step.part in names]
    for name in chosen:
        _entries_of(folder, name).unlink(missing_ok=True)
    # On the pretend device the seconds of imports would be most of a step.
    groups = [chosen] if device == "pretend" else [[name] for name in chosen]
    parts = _report(folder, to_come=chosen)
    while groups:
        group = groups.pop(0)
        print(f"{time.strftime('%H:%M:%S')} {', '.join(group)}", flush=True)
        to_come = [name for later in groups for name in later]
        _report(folder, running=group, to_come=to_come)
        began = time.monotonic()
        ended = _run_apart(group, folder, device)
        checks, told = Checks(_entries_of(folder, group[-1])), f"process of {', '.join(group)}"
        if ended:
            checks.add(told, bar="ends", passed=False, why=ended, notes=_last_lines(folder, group))
        inside = [e.get("seconds", 0.0) for name in group for e in read_entries(_entries_of(folder, name))]
        checks.seconds(time.monotonic() - began - sum(inside))  # start and end of the process
        parts = _report(folder, to_come=to_come)
    return failures(parts)


def run_here(names: Sequence[str], folder: Path, kind: str) -> None:
    """Run steps in this process."""
    from device import Gpu
    from gpu_day.context import Context, Sizes

    if kind == "pretend":
        from gpu_day.pretend import CUT, PretendGpu

        device, sizes = PretendGpu(), CUT
    else:
        device, sizes = Gpu(), Sizes()
    for name in names:
        checks, began = Checks(_entries_of(folder, name)), time.monotonic()
        module, function = STEPS[name].function.split(".")
        try:
            run = getattr(import_module(f"gpu_day.{module}"), function)
            with device.running():
                run(Context(checks, device, sizes, folder))
        except Exception as error:  # whatever it is, the other steps shall run
            traceback.print_exc()
            checks.add(f"step {name}", bar="ends", passed=False, why=f"{type(error).__name__}: {error}")
        checks.seconds(time.monotonic() - began)


def _run_apart(names: Sequence[str], folder: Path, device: str) -> str:
    """Run steps in a new process; return how it ended if not well."""
    log, limit = _log_of(folder, names), sum(STEPS[name].limit for name in names)
    for path in (log, _entries_of(folder, names[0])):
        path.parent.mkdir(parents=True, exist_ok=True)
    environment = dict(os.environ)
    if device == "pretend":
        environment |= {"CUDA_VISIBLE_DEVICES": "", "TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), "--output", str(folder), "--device", device]
    with log.open("wb") as file:
        # In a session of its own, so that what it starts is stopped with it.
        process = subprocess.Popen(
            [*command, "--steps", *names],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            return f"stopped after {limit} s"
        finally:
            _stop(process)
    if code < 0:
        return f"ended by signal {-code} ({signal.strsignal(-code)})"
    return f"ended with exit code {code}" if code else ""


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Stop a process and all that it has started."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        return
    process.wait()


def _report(folder: Path, *, running: Sequence[str] = (), to_come: Sequence[str] = ()) -> list[Part]:
    """Write the report from what the steps have written so far; return its parts."""
    parts = {name: Part(name, title) for name, title in PARTS.items()}
    machine: dict[str, Any] = {}
    for name, step in STEPS.items():
        part = parts[step.part]
        for entry in read_entries(_entries_of(folder, name)):
            machine |= entry.get("machine", {})
            part.seconds += entry.get("seconds", 0.0)
            if "check" in entry:
                part.checks.append(Check(**entry["check"]))
    for name, part in parts.items():
        waiting = any(STEPS[step].part == name for step in (*running, *to_come))
        started = bool(part.checks) or any(STEPS[step].part == name for step in running)
        part.state = "running" if started and waiting else "to come" if waiting else "done"
        if not (started or waiting):
            part.state = "not run"
    write_report(folder, machine, list(parts.values()))
    return list(parts.values())


def _entries_of(folder: Path, step: str) -> Path:
    return folder / "checks" / f"{step}.jsonl"


def _log_of(folder: Path, steps: Sequence[str]) -> Path:
    return folder / "logs" / f"{steps[0]}.log"


def _last_lines(folder: Path, steps: Sequence[str]) -> list[str]:
    return _log_of(folder, steps).read_text(encoding="utf-8", errors="replace").splitlines()[-15:]


if __name__ == "__main__":
    main()
