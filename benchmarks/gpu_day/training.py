# SPDX-License-Identifier: Apache-2.0
"""Part 4: training by the commands that a user types, to a known loss; killed; on several GPUs."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from gpu_day.context import Context
from raytran.checkpoints.file import read_newest
from raytran.checkpoints.runs import LAST, read_finished
from raytran.run.entry import compose
from raytran.run.path_settings import quoted
from raytran.run.train.build import build_data
from raytran.training.history import read_history

STAGES = ("stage1", "stage2", "stage3")

SAME_LOSSES = 1e-3
"""Of one GPU and several, over the size of the loss, in 20 steps."""

RANK_STEPS = 20


@dataclass
class Command:
    """A command of raytran that runs beside others.

    Attributes:
        process: of it.
        log: file of what it prints.
    """

    process: subprocess.Popen[bytes]
    log: Path

    def end(self) -> int:
        """Wait for its end, and return its exit code."""
        return self.process.wait()

    def last_lines(self, count: int = 15) -> list[str]:
        """Return the end of what it printed."""
        return self.log.read_text(encoding="utf-8", errors="replace").splitlines()[-count:]


def start(verb: str, log: Path, *arguments: str, environment: Mapping[str, str] | None = None) -> Command:
    """Start ``python -m raytran.<verb> …``."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", f"raytran.{verb}", *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            cwd=log.parent,
            env={**os.environ, **(environment or {})},
        )
    return Command(process, log)


def commands(context: Context) -> None:
    """Train the tiny curriculum in each precision, and a first stage that is killed, side by side."""
    folder = context.output / "training"
    shutil.rmtree(folder, ignore_errors=True)
    settings = _settings(context, folder)
    # First: commands side by side would all make them.
    build_data(compose("train", [*settings, "output_dir=unused"])).prepare_data()
    running = {
        precision: start(
            "curriculum",
            folder / f"{precision}.log",
            *settings,
            f"precision={precision}",
            f"output_dir={quoted(folder / precision)}",
            environment=_one_gpu(number),
        )
        for number, precision in enumerate(context.sizes.precisions)
    }
    saved, resumed = _kill_and_resume(context, folder)
    for precision, command in running.items():
        with context.checks.attempt(f"curriculum in {precision}"):
            _judge_curriculum(context, folder, precision, command)
    with context.checks.attempt("killed and resumed"):
        _judge_resumed(context, folder, saved, resumed)


def several_gpus(context: Context) -> None:
    """Take the same steps on one GPU and on all of them."""
    count = torch.cuda.device_count()
    name, bar = f"losses of {RANK_STEPS} steps on one GPU and on {count}", f"within {SAME_LOSSES:.0e}"
    if count < 2:
        context.checks.add("losses on one GPU and on several", bar=bar, why="there are not two GPUs")
        return
    folder = context.output / "ranks"
    shutil.rmtree(folder, ignore_errors=True)
    with context.checks.attempt(name, bar):
        compare_ranks(
            context, folder, count, one=["trainer=gpu"], several=["trainer=ddp", f"trainer.devices={count}"]
        )


def compare_ranks(
    context: Context, folder: Path, count: int, *, one: Sequence[str], several: Sequence[str]
) -> None:
    """Check that ``count`` ranks of one scene take the steps that one of ``count`` scenes takes.

    The callback RankAgreement, which is in every run, ends the command if two ranks differ in one bit.
    """
    name, bar = f"losses of {RANK_STEPS} steps on one GPU and on {count}", f"within {SAME_LOSSES:.0e}"
    shared = [
        *_settings(context, folder),
        "experiment=stage1",
        f"rooms.num_train={max(count, 4)}",
        "precision=32-true",
        f"trainer.max_steps={RANK_STEPS}",
        f"trainer.val_check_interval={RANK_STEPS}",
        "schedule.log_every=1",
        f"schedule.batch={count}",
        # At tiny's own rate of 1e-3 rounding alone parts two runs by 0.1 within 20 steps (seen on a CPU).
        "schedule.stage1.learning_rate=1.0e-4",
    ]
    # TF32 would round the same products differently for other numbers of scenes.
    exact = {"NVIDIA_TF32_OVERRIDE": "0"}
    histories = []
    for label, batch, trainer in (("one", count, one), ("several", 1, several)):
        output = folder / label
        arguments = [*shared, *trainer, f"views.batch_size={batch}", f"output_dir={quoted(output)}"]
        command = start("train", folder / f"{label}.log", *arguments, environment=exact)
        if code := command.end():
            told = " / ".join(command.last_lines(3))
            raise RuntimeError(f"raytran.train on {label} ended with code {code}: {told}")
        histories.append([loss for _, loss in read_history(output)["train/total"]])
    worst = max(abs(a - b) / max(abs(a), 1.0) for a, b in zip(*histories, strict=True))
    measured = f"{worst:.1e} in {len(histories[0])} steps; all ranks the same bits"
    passed = worst <= SAME_LOSSES and len(histories[0]) == RANK_STEPS
    context.checks.add(name, bar=bar, measured=measured, passed=passed)


def _settings(context: Context, folder: Path) -> list[str]:
    """Return what all runs share."""
    rooms = f"data.root={quoted(folder / 'rooms')}"
    common = ["preset=tiny", rooms, "rooms.make=true", "progress_bar=none", "watch.pictures=0"]
    return [*common, *context.device.command, *context.sizes.training]


def _one_gpu(number: int) -> dict[str, str]:
    """Return the environment in which a command sees one GPU, if it can another one for each number."""
    count = torch.cuda.device_count()
    given = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    names = given or [str(index) for index in range(count)]
    return {"CUDA_VISIBLE_DEVICES": names[number % count]} if count > 1 else {}


def _judge_curriculum(context: Context, folder: Path, precision: str, command: Command) -> None:
    """Check that a curriculum ends, what it has learned, and that evaluation and prediction work from it."""
    checks, sizes = context.checks, context.sizes
    output = folder / precision
    code = command.end()
    ended = code == 0 and read_finished(output) is not None
    told = f"exit code {code}"
    name = f"curriculum in {precision}"
    checks.add(name, bar="ends", measured=told, passed=ended, notes=[] if ended else command.last_lines())
    if not ended:
        return
    for stage, most in sizes.losses.items():
        losses = [loss for _, loss in read_history(output / stage)["train/total"]]
        last = losses[-10:]
        mean = sum(last) / len(last)
        name = f"loss of {stage} in {precision}"
        told = f"{losses[0]:.3g} → {mean:.3g}"
        checks.add(name, bar=f"mean of the last ten logged ≤ {most:g}", measured=told, passed=mean <= most)
    checkpoint, number = output / STAGES[-1] / LAST, sizes.precisions.index(precision)
    shared = [f"checkpoint={quoted(checkpoint)}"]
    evaluated, predicted = folder / f"{precision}-evaluated", folder / f"{precision}-predicted"
    rooms = folder / "rooms"
    scene = min((rooms / "scannet" / "scans").iterdir())
    jobs = {
        "evaluate": ["split=train", f"data.root={quoted(rooms)}", f"output={quoted(evaluated)}"],
        "predict": [f"scene={quoted(scene)}", f"output={quoted(predicted)}", *sizes.prediction],
    }
    running = {
        verb: start(verb, folder / f"{precision}-{verb}.log", *shared, *more, environment=_one_gpu(number))
        for verb, more in jobs.items()
    }
    with checks.attempt(f"evaluate after {precision}"):
        _judge_evaluation(context, precision, running["evaluate"], evaluated)
    with checks.attempt(f"predict after {precision}"):
        code, wanted = running["predict"].end(), ("scene.json", "scene.glb", "topdown.png")
        found = [file for file in wanted if (predicted / file).is_file()]
        passed = code == 0 and len(found) == len(wanted)
        told, notes = f"exit code {code}, {len(found)} of them", running["predict"].last_lines()
        bar = f"writes {', '.join(wanted)}"
        name = f"predict after {precision}"
        checks.add(name, bar=bar, measured=told, passed=passed, notes=[] if passed else notes)


def _judge_evaluation(context: Context, precision: str, command: Command, output: Path) -> None:
    name, bar = f"F1 at IoU 0.25 of the training rooms, {precision}", f"≥ {context.sizes.score:g}"
    code = command.end()
    if code:
        notes = command.last_lines()
        context.checks.add(name, bar=bar, measured=f"exit code {code}", passed=False, notes=notes)
        return
    metrics = json.loads((output / "metrics.json").read_text(encoding="utf-8"))
    f1 = metrics["strict"]["per_threshold"]["0.25"]["f1"]
    occupancy, foreground = metrics["occupancy_iou"], metrics["foreground_iou"]
    told = f"{f1:.2f}; IoU of occupancy {occupancy:.2f}, of foreground {foreground:.2f}"
    context.checks.add(name, bar=bar, measured=told, passed=f1 >= context.sizes.score)


def _kill_and_resume(context: Context, folder: Path) -> tuple[int | None, Command]:
    """Kill a first stage once it has written a checkpoint, and go on.

    Returns:
        The step it had saved, None if it ended by itself; and the command that goes on.
    """
    output, precision = folder / "killed", context.sizes.precisions[0]
    arguments = [
        *_settings(context, folder),
        "experiment=stage1",
        f"precision={precision}",
        f"output_dir={quoted(output)}",
        "resume=auto",
        *context.sizes.killed,
    ]
    # On the GPU of its twin, which is the curriculum's first stage.
    first = start("train", folder / "killed.log", *arguments, environment=_one_gpu(0))
    while first.process.poll() is None and not (output / LAST).is_file():
        time.sleep(0.02)
    first.process.send_signal(signal.SIGKILL)
    saved = None
    if first.end() == -signal.SIGKILL:
        found = read_newest((output / LAST).parent)
        saved = 0 if found is None else int(found[1]["global_step"])
    return saved, start("train", folder / "resumed.log", *arguments, environment=_one_gpu(0))


def _judge_resumed(context: Context, folder: Path, saved: int | None, command: Command) -> None:
    """Compare a run that was killed with one that was not: the first stage of the curriculum."""
    checks, name, bar = context.checks, "killed by SIGKILL and resumed", "as many steps, a finite loss"
    code = command.end()
    twin, output = folder / context.sizes.precisions[0] / STAGES[0], folder / "killed"
    finished = [read_finished(path) for path in (output, twin)]
    if saved is None or code or None in finished:
        told = "it ended before it was killed" if saved is None else f"exit code {code}"
        checks.add(name, bar=bar, measured=told, passed=False, notes=command.last_lines())
        return
    steps = [mark.steps for mark in finished if mark is not None]
    losses = [read_history(path)["train/total"][-1][1] for path in (output, twin)]
    told = f"saved at step {saved}, then {steps[0]} of {steps[1]} steps, "
    told += f"loss {losses[0]:.4g} for {losses[1]:.4g}"
    passed = steps[0] == steps[1] and 0 < saved < steps[0] and math.isfinite(losses[0])
    checks.add(name, bar=bar, measured=told, passed=passed)
    states = [
        torch.load(path / LAST, map_location="cpu", weights_only=True)["state_dict"]
        for path in (output, twin)
    ]
    other = [key for key, value in states[1].items() if not torch.equal(value, states[0][key])]
    told = f"{len(other)} of {len(states[1])} tensors differ" if other else "every weight has the same bits"
    checks.add("bits of the resumed run", measured=told)
