# SPDX-License-Identifier: Apache-2.0
"""The three stages of training, one after another (RayTran §4); killed anywhere, it goes on where it was."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from raytran.checkpoints.runs import LAST, one_at_a_time, read_finished, write_finished
from raytran.data.files import SettingsRecord
from raytran.data.workers import ENDS_WITH
from raytran.errors import ConfigError, RaytranError
from raytran.run.entry import compose, typed_config_dir, typed_settings, user_environment
from raytran.run.path_settings import quoted
from raytran.run.train.fit import FitResult, train
from raytran.run.train.next_command import tell_use
from raytran.training.callbacks.stop_signals import forward_signals

_log = logging.getLogger(__name__)

STAGES = ("stage1", "stage2", "stage3")
RECORD = "curriculum.json"
_OWN = ("stages", "output_dir", "resume")


def curriculum(cfg: DictConfig) -> list[FitResult]:
    """Run ``raytran curriculum``: the overrides typed there hold for every stage."""
    overrides = [
        item for item in typed_settings(HydraConfig.get()) if item.split("=")[0].lstrip("+~") not in _OWN
    ]
    results = run_curriculum(overrides, output_dir=Path(cfg.output_dir), stages=tuple(cfg.stages))
    tell_use(results[-1].checkpoint)
    return results


def run_curriculum(
    overrides: Sequence[str],
    *,
    output_dir: Path,
    stages: Sequence[str] = STAGES,
    of_stage: Mapping[str, Sequence[str]] | None = None,
) -> list[FitResult]:
    """Train the stages in turn, each from the weights of the one before.

    Each stage is a fit of its own in ``output_dir/<experiment>``. A stage that has finished is skipped, one
    that was interrupted goes on from its last checkpoint.

    Args:
        overrides: settings for all stages as typed after ``raytran train``, without ``experiment``.
        output_dir: folder of the curriculum.
        stages: experiments, in order.
        of_stage: settings of single stages, by experiment, that win over ``overrides``.

    Raises:
        ConfigError: ``overrides`` names an experiment, there is no such setting or stage, or the folder holds
            a curriculum with other settings.
    """
    if any(item.startswith("experiment=") for item in overrides):
        raise ConfigError(f"a curriculum runs the experiments {list(stages)}: choose them with stages=[…]")
    presets = [
        compose("train", [*overrides, f"experiment={name}", "output_dir=none"]).preset for name in stages
    ]
    with one_at_a_time(output_dir):
        _record(output_dir, overrides, stages)
        return _train_stages(overrides, output_dir, stages, presets, of_stage or {})


def _train_stages(
    overrides: Sequence[str],
    output_dir: Path,
    stages: Sequence[str],
    presets: Sequence[str],
    of_stage: Mapping[str, Sequence[str]],
) -> list[FitResult]:
    """Train the stages that have not finished."""
    results: list[FitResult] = []
    for number, experiment in enumerate(stages, start=1):
        _log.info("stage %d of %d: experiment=%s", number, len(stages), experiment)
        folder = output_dir / experiment
        own = of_stage.get(experiment, ())
        settings = [
            *overrides,
            *own,
            f"experiment={experiment}",
            f"output_dir={quoted(folder)}",
            "resume=auto",
        ]
        if results:
            settings.append(f"init_from={quoted(results[-1].checkpoint)}")
        results.append(_fit(settings, folder))
    write_finished(
        output_dir,
        stage="curriculum",
        preset=presets[-1],
        experiment="curriculum",
        steps=results[-1].steps,
    )
    _log.info("curriculum finished: %s", results[-1].checkpoint)
    return results


def _fit(settings: Sequence[str], folder: Path) -> FitResult:
    """Train one stage: in this process on one device, else as a command of its own.

    Raises:
        RaytranError: the command failed.
    """
    cfg = compose("train", settings)
    if str(cfg.trainer.devices) == "1" and cfg.trainer.num_nodes == 1:
        return train(cfg)
    code = _run([sys.executable, "-m", "raytran.train", *_config_dir(), *settings])
    finished = read_finished(folder)
    if code != 0 or finished is None:
        raise RaytranError(
            f"the stage in {folder} stopped with exit code {code}: mend what it says above, "
            "then give the same command again to continue"
        )
    return FitResult(folder, folder / LAST, finished.steps, 0.0, {})


def _config_dir() -> list[str]:
    return typed_config_dir(HydraConfig.get()) if HydraConfig.initialized() else []


def _run(command: Sequence[str]) -> int:
    """Run a command and return its exit code; forward signals to it, and stop after it if one came."""
    stopped_by = 0
    with subprocess.Popen(command, env=user_environment() | {ENDS_WITH: str(os.getpid())}) as process:

        def stop(signum: int) -> None:
            nonlocal stopped_by
            stopped_by = signum
            if signum != signal.SIGINT:  # Ctrl-C reaches all processes of a terminal
                process.send_signal(signum)

        with forward_signals(stop):
            code = process.wait()
    if stopped_by and code != 0:
        raise SystemExit(128 + stopped_by)
    return code


def _record(output_dir: Path, overrides: Sequence[str], stages: Sequence[str]) -> None:
    """Write down the settings of a new curriculum; refuse to continue one that had others."""
    record = SettingsRecord(output_dir / RECORD)
    if not record.begin({"overrides": sorted(overrides), "stages": list(stages)}):
        return
    earlier = record.read()
    if "overrides" not in earlier:
        raise ConfigError(f"{record.path} is damaged: delete it and give the same command again")
    typed = " ".join(earlier["overrides"]) or "no overrides"
    raise ConfigError(
        f"{output_dir} holds an unfinished curriculum that was started with {typed}: "
        "give the same to continue it, or resume=none to start a new one"
    )
