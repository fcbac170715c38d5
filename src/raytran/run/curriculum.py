# SPDX-License-Identifier: Apache-2.0
"""The three stages of training, one after another (RayTran §4); killed anywhere, it goes on where it was."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from raytran.errors import ConfigError, RaytranError
from raytran.run.entry import compose
from raytran.run.folders import LAST, read_finished, write_finished
from raytran.run.train import FitResult, train

_log = logging.getLogger(__name__)

STAGES = ("stage1", "stage2", "stage3")
RECORD = "curriculum.json"
_OWN = ("stages", "output_dir", "resume")


def curriculum(cfg: DictConfig) -> list[FitResult]:
    """Run ``python -m raytran.curriculum``: the overrides typed there hold for every stage."""
    overrides = [
        item for item in HydraConfig.get().overrides.task if item.split("=")[0].lstrip("+~") not in _OWN
    ]
    return run_curriculum(overrides, output_dir=Path(cfg.output_dir), stages=tuple(cfg.stages))


def run_curriculum(
    overrides: Sequence[str], *, output_dir: Path, stages: Sequence[str] = STAGES
) -> list[FitResult]:
    """Train the stages in turn, each from the weights of the one before.

    Each stage is a fit of its own in ``output_dir/<experiment>``. A stage that has finished is skipped, one
    that was interrupted goes on from its last checkpoint.

    Args:
        overrides: settings for all stages as typed after ``python -m raytran.train``, without ``experiment``.
        output_dir: folder of the curriculum.
        stages: experiments, in order.

    Raises:
        ConfigError: ``overrides`` names an experiment, or the folder holds a curriculum with other settings.
    """
    if any(item.startswith("experiment=") for item in overrides):
        raise ConfigError(f"a curriculum runs the experiments {list(stages)}: choose them with stages=[…]")
    _record(output_dir, overrides, stages)
    results: list[FitResult] = []
    for number, experiment in enumerate(stages, start=1):
        _log.info("stage %d of %d: experiment=%s", number, len(stages), experiment)
        folder = output_dir / experiment
        settings = [*overrides, f"experiment={experiment}", f"output_dir={_quoted(folder)}", "resume=auto"]
        if results:
            settings.append(f"init_from={_quoted(results[-1].checkpoint)}")
        results.append(_fit(settings, folder))
    write_finished(
        output_dir,
        stage="curriculum",
        preset=_preset(overrides),
        experiment="curriculum",
        steps=results[-1].steps,
    )
    _log.info("curriculum finished: %s", results[-1].checkpoint)
    return results


def _fit(settings: Sequence[str], folder: Path) -> FitResult:
    """Train one stage: in this process on one device, else as a command of its own."""
    cfg = compose("train", settings)
    if str(cfg.trainer.devices) == "1" and cfg.trainer.num_nodes == 1:
        return train(cfg)
    done = subprocess.run([sys.executable, "-m", "raytran.train", *settings], check=False)
    finished = read_finished(folder)
    if done.returncode != 0 or finished is None:
        raise RaytranError(
            f"the stage in {folder} stopped with exit code {done.returncode}: mend what it says above, "
            "then give the same command again to continue"
        )
    return FitResult(folder, folder / LAST, finished.steps, 0.0, {})


def _record(output_dir: Path, overrides: Sequence[str], stages: Sequence[str]) -> None:
    """Write down the settings of a new curriculum; refuse to continue one that had others."""
    path = output_dir / RECORD
    settings = {"overrides": sorted(overrides), "stages": list(stages)}
    if path.is_file():
        earlier = json.loads(path.read_text())
        if earlier != settings:
            typed = " ".join(earlier["overrides"]) or "no overrides"
            raise ConfigError(
                f"{output_dir} holds an unfinished curriculum that was started with {typed}: "
                "give the same to continue it, or resume=none to start a new one"
            )
        return
    output_dir.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".part")
    partial.write_text(json.dumps(settings, indent=2) + "\n")
    os.replace(partial, path)


def _preset(overrides: Sequence[str]) -> str:
    return str(compose("train", [*overrides, "output_dir=none"]).preset)


def _quoted(path: Path) -> str:
    """Return a path as Hydra's override grammar wants it."""
    escaped = str(path).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
