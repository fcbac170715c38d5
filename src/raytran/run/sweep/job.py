# SPDX-License-Identifier: Apache-2.0
"""One job of a sweep: its command, its folder and how far it is."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from omegaconf import DictConfig

from raytran.checkpoints.runs import read_finished
from raytran.run.entry import typed_config_dir
from raytran.run.path_settings import quoted
from raytran.run.sweep.folder import own_settings
from raytran.run.train.settings import given_steps
from raytran.training.history import newest_values

CONSOLE = "console.log"
FINISHED, FAILED, STOPPED, NOT_STARTED = "finished", "failed", "stopped", "not started"

_LOSS = "train/total"


class Standing(NamedTuple):
    """How far a job is.

    Attributes:
        share: of its way, 0 to 1.
        text: ``step 40 of 150, loss 1.23, val/occupancy/iou 0.27``, as far as it has been logged.
    """

    share: float
    text: str


@dataclass
class Job:
    """One job of a sweep.

    Attributes:
        number: in the sweep, from 0.
        overrides: its settings as the sweeper gave them.
        folder: of its run.
        config: composed from the settings.
        title: those of its settings that tell it from the others.
        status: one of the four above.
        process: its command, once that has been started.
        gpus: the GPUs that it has for itself while it runs.
        totals: steps that each of its runs will take, as far as they have been looked up.
    """

    number: int
    overrides: tuple[str, ...]
    folder: Path
    config: DictConfig
    title: str = ""
    status: str = NOT_STARTED
    process: subprocess.Popen[bytes] | None = None
    gpus: list[str] = field(default_factory=list)
    totals: dict[Path, int] = field(default_factory=dict)

    def command(self, general: Sequence[str]) -> list[str]:
        """Return the command line.

        Args:
            general: settings of Hydra itself that hold for every job.
        """
        own = own_settings(self.overrides)
        typed = {item.lstrip("+~").split("=")[0] for item in own}
        usual = {"resume": "auto", "progress_bar": "rich"}  # which in a file is ten lines
        added = [f"{name}={value}" for name, value in usual.items() if name not in typed]
        program = f"raytran.{self.config.hydra.job.config_name}"
        words = [*own, *added, f"output_dir={quoted(self.folder)}", *general, "hydra.mode=RUN"]
        return [sys.executable, "-m", program, *typed_config_dir(self.config.hydra), *words]

    def gpus_needed(self, total: int) -> int:
        """Return how many of the machine's ``total`` GPUs the job needs for itself."""
        trainer = self.config.trainer
        if str(trainer.accelerator) == "cpu":
            return 0
        try:
            return min(int(trainer.devices), total) if int(trainer.devices) >= 0 else total
        except (TypeError, ValueError):
            return total  # a list of devices or "auto": nothing may run beside it

    @property
    def name(self) -> str:
        """Return what tells the job from the others, its number if nothing does."""
        return self.title or f"job {self.number}"

    def standing(self) -> Standing:
        """Return how far the job is, by what its run has logged; a curriculum's stages count alike."""
        if read_finished(self.folder) is not None:
            return Standing(1.0, FINISHED)
        runs = self._runs()
        finished = sum(read_finished(run) is not None for run in runs)
        current = runs[min(finished, len(runs) - 1)]
        metric = str(self.config.optimized_metric)
        steps, values = newest_values(current, {_LOSS, metric})
        total = self._total(current)
        said = [current.name] if len(runs) > 1 else []
        said.append(f"step {steps}" + (f" of {total}" if total else ""))
        said += [
            f"{shown} {values[name]:.4g}"
            for name, shown in ((_LOSS, "loss"), (metric, metric))
            if name in values
        ]
        share = min(1.0, steps / total) if total else 0.0
        return Standing(min(1.0, (finished + share) / len(runs)), ", ".join(said) if steps else "starts")

    def has_trained(self) -> bool:
        """Return whether the job has taken a step, in this call or an earlier one."""
        return any(newest_values(run, ())[0] for run in self._runs())

    def said_last(self) -> str:
        """Return the last thing the command said, without Hydra's advice on how to hear more."""
        lines = (self.folder / CONSOLE).read_text(encoding="utf-8", errors="replace").strip().splitlines()
        said = [line for line in lines if line.strip() and "HYDRA_FULL_ERROR" not in line]
        return said[-1] if said else "it said nothing"

    def _runs(self) -> list[Path]:
        """Return the folders of the job's runs, one a stage."""
        names = self.config.get("stages")
        return [self.folder / str(name) for name in names] if names else [self.folder]

    def _total(self, run: Path) -> int:
        """Return how many steps a run will take, 0 if that is not known (yet)."""
        if run not in self.totals:
            total = given_steps(run) or 0
            if total <= 0:
                return 0
            self.totals[run] = total
        return self.totals[run]
