# SPDX-License-Identifier: Apache-2.0
"""The jobs of a sweep as processes: which command, with which GPUs, when, and how it ended."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from omegaconf import DictConfig

from raytran.checkpoints.runs import read_finished
from raytran.run.entry import quoted, typed_config_dir, user_environment
from raytran.run.sweep.folder import THIS_SWEEP, last_value, own_settings
from raytran.run.sweep.table import FAILED, FINISHED, FINISHED_BEFORE, NOT_STARTED, STOPPED, JobResult

_log = logging.getLogger(__name__)

CONSOLE = "console.log"
RANK_VARIABLES = (
    *("RANK", "LOCAL_RANK", "GLOBAL_RANK", "GROUP_RANK", "NODE_RANK", "ROLE_RANK", "WORLD_SIZE"),
    *("LOCAL_WORLD_SIZE", "GROUP_WORLD_SIZE", "ROLE_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"),
    *("SLURM_NTASKS", "SLURM_NTASKS_PER_NODE", "SLURM_PROCID", "SLURM_LOCALID"),
    *("PL_GLOBAL_SEED", "PL_SEED_WORKERS", "TORCHELASTIC_RUN_ID"),
)
"""What tells a process that it is one rank of several; a job is not."""

_NOT_HANDED_ON = {*RANK_VARIABLES, THIS_SWEEP}
_STOP = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
_POLL_SECONDS = 0.2


@dataclass(frozen=True)
class Job:
    """One job of a sweep.

    Attributes:
        number: in the sweep, from 0.
        overrides: its settings as the sweeper gave them.
        folder: of its run.
        config: composed from the settings.
        program: name of the root config, e.g. ``train``.
        title: those of its settings that not all jobs share.
    """

    number: int
    overrides: tuple[str, ...]
    folder: Path
    config: DictConfig
    program: str
    title: str

    def command(self, general: Sequence[str]) -> list[str]:
        """Return the command line.

        Args:
            general: settings of Hydra itself that hold for every job.
        """
        own = own_settings(self.overrides)
        typed = {item.lstrip("+~").split("=")[0] for item in own}
        usual = {"resume": "auto", "progress_bar": "none"}
        added = [f"{name}={value}" for name, value in usual.items() if name not in typed]
        words = [*own, *added, f"output_dir={quoted(self.folder)}", *general, "hydra.mode=RUN"]
        return [sys.executable, "-m", f"raytran.{self.program}", *typed_config_dir(self.config.hydra), *words]

    def gpus(self, total: int) -> int:
        """Return how many of the machine's ``total`` GPUs the job needs for itself."""
        trainer = self.config.trainer
        if str(trainer.accelerator) == "cpu":
            return 0
        try:
            return min(int(trainer.devices), total) if int(trainer.devices) >= 0 else total
        except (TypeError, ValueError):
            return total  # a list of devices or "auto": nothing may run beside it

    def result(self, status: str, exit_code: int | None = None, seconds: float = 0.0) -> JobResult:
        """Return how the job ended, with what it wrote."""
        metric = str(self.config.optimized_metric)
        value, logged = (
            last_value(self.folder, metric) if status in (FINISHED, FINISHED_BEFORE) else (None, [])
        )
        if logged and value is None:
            wanted = ", ".join(name for name in logged if name.startswith("val/")) or "none"
            _log.warning("job %d logged no %s: optimized_metric can be %s", self.number, metric, wanted)
        mark = read_finished(self.folder)
        steps = None if mark is None else mark.steps
        return JobResult(
            number=self.number,
            overrides=tuple(own_settings(self.overrides)),
            folder=self.folder,
            status=status,
            exit_code=exit_code,
            metric=metric,
            value=value,
            steps=steps,
            seconds=seconds,
        )


@dataclass
class _Running:
    """A job whose process lives."""

    job: Job
    process: subprocess.Popen[bytes]
    gpus: list[str]
    since: float = field(default_factory=time.monotonic)


class JobPool:
    """Runs jobs, so many at a time and each with GPUs of its own.

    Args:
        limit: jobs at a time.
        gpus: names of all GPUs.
        general: settings of Hydra for every job.
        lock: descriptor that each job inherits, see ``one_at_a_time``.
    """

    def __init__(self, limit: int, gpus: Sequence[str], general: Sequence[str], lock: int) -> None:
        self._limit, self._all_gpus, self._free = limit, list(gpus), list(gpus)
        self._general, self._lock = general, lock
        self._running: list[_Running] = []
        self.stopped_by: int | None = None

    def run(self, jobs: Sequence[Job]) -> list[JobResult]:
        """Run the jobs in order and return how each ended; a signal ends it early."""
        results: dict[int, JobResult] = {}
        waiting: deque[Job] = deque()
        for job in {job.number: job for job in jobs}.values():  # a sampler may draw the same twice
            if read_finished(job.folder) is None:
                waiting.append(job)
            else:
                results[job.number] = job.result(FINISHED_BEFORE)
                _log.info("job %d has finished before: %s", job.number, job.title)
        with self._forwarded_signals():
            while waiting or self._running:
                while waiting and self.stopped_by is None and self._has_room(waiting[0]):
                    self._start(waiting.popleft())
                if self.stopped_by is not None:
                    waiting.clear()
                time.sleep(_POLL_SECONDS)
                for ended in [item for item in self._running if item.process.poll() is not None]:
                    self._running.remove(ended)
                    self._free += ended.gpus
                    results[ended.job.number] = self._end(ended)
        return [results.get(job.number) or job.result(NOT_STARTED) for job in jobs]

    def _has_room(self, job: Job) -> bool:
        return len(self._running) < self._limit and job.gpus(len(self._all_gpus)) <= len(self._free)

    def _start(self, job: Job) -> None:
        gpus = [self._free.pop(0) for _ in range(job.gpus(len(self._all_gpus)))]
        job.folder.mkdir(parents=True, exist_ok=True)
        _log.info("job %d starts: %s (%s)", job.number, job.title, job.folder / CONSOLE)
        with (job.folder / CONSOLE).open("ab") as console:
            process = subprocess.Popen(
                job.command(self._general),
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=subprocess.STDOUT,
                env=self._environment(gpus),
                pass_fds=(self._lock,),
                start_new_session=True,  # Ctrl-C reaches a job once, through us
            )
        self._running.append(_Running(job, process, gpus))

    def _environment(self, gpus: Sequence[str]) -> dict[str, str]:
        environment = {key: value for key, value in user_environment().items() if key not in _NOT_HANDED_ON}
        if gpus:
            environment["CUDA_VISIBLE_DEVICES"] = ",".join(gpus)
        if self._limit > 1:
            # Each would take all cores otherwise, and wait for the others most of the time.
            environment.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // self._limit)))
        return environment

    def _end(self, ended: _Running) -> JobResult:
        job, code = ended.job, ended.process.returncode
        seconds = time.monotonic() - ended.since
        is_finished = code == 0 and read_finished(job.folder) is not None
        status = FINISHED if is_finished else FAILED if self.stopped_by is None else STOPPED
        result = job.result(status, code, seconds)
        if status == FAILED:
            _log.error(
                "job %d failed with exit code %d: %s", job.number, code, _last_line(job.folder / CONSOLE)
            )
        else:
            said = "" if result.value is None else f", {result.metric} = {result.value:.4g}"
            _log.info("job %d %s after %.0f s%s", job.number, status, seconds, said)
        return result

    @contextmanager
    def _forwarded_signals(self) -> Iterator[None]:
        """Hand a signal that asks to stop on to the jobs, which save; the second one ends them at once."""
        before = {number: signal.signal(number, self._stop) for number in _STOP}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _stop(self, number: int, _frame: FrameType | None) -> None:
        again, self.stopped_by = self.stopped_by is not None, number
        for item in self._running:
            if again:
                os.killpg(item.process.pid, signal.SIGKILL)
            else:
                item.process.send_signal(signal.SIGTERM)


def _last_line(path: Path) -> str:
    """Return the last thing a command said, without Hydra's advice on how to hear more."""
    lines = path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    said = [line for line in lines if line.strip() and "HYDRA_FULL_ERROR" not in line]
    return said[-1] if said else "it said nothing"
