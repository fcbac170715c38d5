# SPDX-License-Identifier: Apache-2.0
"""Sweeps: each job is a command of its own, with its own world size, folder and GPUs.

Run inside one process, as Hydra's own launcher does it, a job on two devices leaves its rank behind, and
Lightning takes the next job for a part of the first.
"""

from __future__ import annotations

import csv
import io
import logging
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hydra.core.config_loader import ConfigLoader
from hydra.core.utils import JobReturn, JobStatus, configure_log
from omegaconf import DictConfig, OmegaConf, open_dict

from raytran.checkpoints.runs import one_at_a_time, read_finished
from raytran.data.files import write_text
from raytran.errors import ConfigError, RaytranError
from raytran.run.entry import typed_config_dir, typed_settings, user_environment
from raytran.run.path_settings import quoted
from raytran.run.sweep.folder import RECORD, THIS_SWEEP, last_value, own_settings, read_record, write_record
from raytran.training.callbacks.stop_signals import forward_signals

_log = logging.getLogger(__name__)

CONSOLE, RESULTS = "console.log", "results.csv"
FINISHED, FAILED, STOPPED, NOT_STARTED = "finished", "failed", "stopped", "not started"

_NOT_FOR_A_JOB = {
    *("RANK", "LOCAL_RANK", "GLOBAL_RANK", "GROUP_RANK", "NODE_RANK", "ROLE_RANK", "WORLD_SIZE"),
    *("LOCAL_WORLD_SIZE", "GROUP_WORLD_SIZE", "ROLE_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"),
    *("SLURM_NTASKS", "SLURM_NTASKS_PER_NODE", "SLURM_PROCID", "SLURM_LOCALID"),
    *("PL_GLOBAL_SEED", "PL_SEED_WORKERS", "TORCHELASTIC_RUN_ID", THIS_SWEEP),
}
"""Environment variables that tell a process that it is one rank of several, which a job is not."""

_OF_SWEEPS = ("hydra.sweep", "hydra/sweep", "hydra.launcher", "hydra/launcher", "hydra.mode", "hydra.run.dir")
"""Settings of Hydra that are not for a single job."""

_POLL_SECONDS = 0.2


@dataclass
class Job:
    """One job of a sweep.

    Attributes:
        number: in the sweep, from 0.
        overrides: its settings as the sweeper gave them.
        folder: of its run.
        config: composed from the settings.
        title: those of its settings that not all jobs share.
        status: one of the four above.
        process: its command, once that has been started.
        gpus: the GPUs that it has for itself while it runs.
    """

    number: int
    overrides: tuple[str, ...]
    folder: Path
    config: DictConfig
    title: str = ""
    status: str = NOT_STARTED
    process: subprocess.Popen[bytes] | None = None
    gpus: list[str] = field(default_factory=list)

    def command(self, general: Sequence[str]) -> list[str]:
        """Return the command line.

        Args:
            general: settings of Hydra itself that hold for every job.
        """
        own = own_settings(self.overrides)
        typed = {item.lstrip("+~").split("=")[0] for item in own}
        usual = {"resume": "auto", "progress_bar": "none"}
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


def launch(
    config: DictConfig,
    loader: ConfigLoader,
    job_overrides: Sequence[Sequence[str]],
    *,
    parallel: int | str = "auto",
) -> list[JobReturn]:
    """Run the jobs of one batch; those that have finished before are not run again.

    Args:
        config: of the whole sweep, Hydra's part included.
        loader: composes the configs of the jobs.
        job_overrides: settings of each job.
        parallel: jobs at a time; ``auto``: on GPUs as many as find devices, on the CPU one.

    Returns:
        Per job its return value, the last value of its ``optimized_metric``, or its failure.

    Raises:
        ConfigError: the same sweep is running already, or a setting makes no sense.
        SystemExit: a signal has stopped the sweep; its jobs have got it too and have ended.
    """
    configure_log(config.hydra.hydra_logging, config.hydra.verbose)
    folder = Path(config.hydra.sweep.dir).absolute()
    # The jobs inherit the lock: a sweep is not taken up again while a job of a killed launcher still trains.
    with one_at_a_time(folder) as lock:
        jobs = _jobs(config, loader, job_overrides, folder)
        gpus = _gpus() if any(job.config.trainer.accelerator != "cpu" for job in jobs) else []
        typed = [str(item) for item in config.hydra.overrides.hydra]
        general = [item for item in typed if not item.lstrip("+~").startswith(_OF_SWEEPS)]
        stopped_by = run_jobs(jobs, gpus, general, lock, limit=_limit(parallel, jobs, gpus))
        values = write_results(folder, jobs)
    if stopped_by:
        _log.info("stopped; the same command goes on with this sweep")
        raise SystemExit(128 + stopped_by)
    return [_job_return(job, values[job.number]) for job in jobs]


def _jobs(
    config: DictConfig, loader: ConfigLoader, job_overrides: Sequence[Sequence[str]], folder: Path
) -> list[Job]:
    """Return the jobs with their folders: those in the sweep's record keep theirs."""
    recorded = read_record(folder)["jobs"] if (folder / RECORD).is_file() else []
    jobs: list[Job] = []
    for overrides in job_overrides:
        settings = own_settings(overrides)
        number = next((i for i, job in enumerate(recorded) if job["overrides"] == settings), len(recorded))
        composed = loader.load_sweep_config(config, list(overrides))
        with open_dict(composed):
            composed.hydra.job.num, composed.hydra.job.id = number, str(number)
        if int(composed.trainer.num_nodes) > 1:
            raise ConfigError("jobs on several machines need a cluster's queue: hydra/launcher=slurm")
        if number == len(recorded):
            recorded.append({"overrides": settings, "folder": str(composed.hydra.sweep.subdir)})
        jobs.append(Job(number, tuple(overrides), folder / recorded[number]["folder"], composed))
    typed = typed_settings(config.hydra)
    write_record(folder, config.hydra.job.config_name, typed, recorded)
    shared = set.intersection(*(set(job["overrides"]) for job in recorded)) if len(recorded) > 1 else set()
    for job in jobs:
        job.title = " ".join(item for item in own_settings(job.overrides) if item not in shared)
    return jobs


def run_jobs(
    jobs: Sequence[Job], gpus: Sequence[str], general: Sequence[str], lock: int, *, limit: int
) -> int:
    """Run the jobs in order, ``limit`` at a time and each with GPUs of its own, and set their status.

    Args:
        jobs: what to run.
        gpus: names of all GPUs.
        general: settings of Hydra for every job.
        lock: descriptor that each job inherits.
        limit: jobs at a time.

    Returns:
        The number of the signal that has stopped the sweep, or 0.
    """
    free, running, waiting = list(gpus), list[Job](), deque[Job]()
    for job in {job.number: job for job in jobs}.values():  # a sampler may draw the same twice
        if read_finished(job.folder) is None:
            waiting.append(job)
        else:
            _log.info("job %d has finished before: %s", job.number, job.title)
    stopped_by = 0

    def stop(signum: int) -> None:
        """Let the jobs save themselves; the second signal ends them at once."""
        nonlocal stopped_by
        for job in running:
            if job.process is None:
                continue
            if stopped_by:
                os.killpg(job.process.pid, signal.SIGKILL)
            else:
                job.process.send_signal(signal.SIGTERM)
        stopped_by = signum

    with forward_signals(stop):
        while running or (waiting and not stopped_by):
            while waiting and not stopped_by and len(running) < limit:
                needed = waiting[0].gpus_needed(len(gpus))
                if needed > len(free):
                    break
                job = waiting.popleft()
                job.gpus = [free.pop(0) for _ in range(needed)]
                _start(job, general, lock, side_by_side=limit)
                running.append(job)
            time.sleep(_POLL_SECONDS)
            for job in [job for job in running if job.process and job.process.poll() is not None]:
                running.remove(job)
                free += job.gpus
                _end(job, stopped=bool(stopped_by))
    return stopped_by


def _start(job: Job, general: Sequence[str], lock: int, *, side_by_side: int) -> None:
    environment = {name: value for name, value in user_environment().items() if name not in _NOT_FOR_A_JOB}
    if job.gpus:
        environment["CUDA_VISIBLE_DEVICES"] = ",".join(job.gpus)
    if side_by_side > 1:
        # Each would take all cores otherwise, and wait for the others most of the time.
        environment.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // side_by_side)))
    job.folder.mkdir(parents=True, exist_ok=True)
    _log.info("job %d starts: %s (%s)", job.number, job.title, job.folder / CONSOLE)
    with (job.folder / CONSOLE).open("ab") as console:
        job.process = subprocess.Popen(
            job.command(general),
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=subprocess.STDOUT,
            env=environment,
            pass_fds=(lock,),
            start_new_session=True,  # Ctrl-C reaches a job once, through us
        )


def _end(job: Job, *, stopped: bool) -> None:
    code = job.process.returncode if job.process else None
    if code == 0 and read_finished(job.folder) is not None:
        job.status = FINISHED
        _log.info("job %d finished", job.number)
        return
    job.status = STOPPED if stopped else FAILED
    if not stopped:
        _log.error("job %d failed with exit code %s: %s", job.number, code, _last_line(job.folder / CONSOLE))


def _last_line(path: Path) -> str:
    """Return the last thing a command said, without Hydra's advice on how to hear more."""
    lines = path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    said = [line for line in lines if line.strip() and "HYDRA_FULL_ERROR" not in line]
    return said[-1] if said else "it said nothing"


def write_results(folder: Path, jobs: Sequence[Job]) -> dict[int, float | None]:
    """Write ``results.csv`` with a row for every job of the sweep, and log the rows.

    What has finished is read from the jobs' folders, whichever call has run it.

    Returns:
        The last value of its metric, or None, for each job by number.
    """
    status = {job.number: job.status for job in jobs}
    metric = str(jobs[0].config.optimized_metric) if jobs else ""
    rows: list[dict[str, object]] = []
    values: dict[int, float | None] = {}
    for number, recorded in enumerate(read_record(folder)["jobs"]):
        mark = read_finished(folder / recorded["folder"])
        values[number] = _value(number, folder / recorded["folder"], metric) if mark else None
        rows.append(
            dict(item.partition("=")[::2] for item in recorded["overrides"])
            | {
                "job": number,
                "status": FINISHED if mark else status.get(number, NOT_STARTED),
                "metric": metric,
                "value": values[number],
                "steps": mark.steps if mark else None,
                "folder": recorded["folder"],
            }
        )
    first = ("job", "status", "metric", "value", "steps", "folder")
    settings = sorted({name for row in rows for name in row} - set(first))
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=[*first, *settings], restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / RESULTS, text.getvalue())
    varied = [name for name in settings if len({row.get(name) for row in rows}) > 1]
    for row in rows:
        _log.info("job %s: %s", row["job"], _line(row, varied))
    return values


def _value(number: int, folder: Path, metric: str) -> float | None:
    """Return the last value of a metric, and say which ones there are where there is none."""
    value, logged = last_value(folder, metric)
    if logged and value is None:
        others = ", ".join(name for name in logged if name.startswith("val/")) or "none"
        _log.warning("job %d logged no %s: optimized_metric can be %s", number, metric, others)
    return value


def _line(row: Mapping[str, object], varied: Sequence[str]) -> str:
    """Return a row in one line: the settings that differ between the jobs, and what came of them."""
    settings = " ".join(f"{name}={row[name]}" for name in varied if name in row)
    value = row["value"]
    score = f", {row['metric']} = {value:.4g}" if isinstance(value, float) else ""
    return f"{settings} {row['status']}{score}".strip()


def _gpus() -> list[str]:
    """Return the names of this machine's GPUs as CUDA_VISIBLE_DEVICES wants them."""
    import torch

    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(index) for index in range(torch.cuda.device_count())]
    return names if torch.cuda.is_available() else []


def _limit(parallel: int | str, jobs: Sequence[Job], gpus: Sequence[str]) -> int:
    if parallel == "auto":
        return max(1, len(gpus)) if any(job.gpus_needed(len(gpus)) for job in jobs) else 1
    try:
        limit = int(parallel)
    except ValueError:
        limit = 0
    if limit < 1:
        raise ConfigError(f"launcher.parallel must be auto or at least 1, got {parallel}")
    return limit


def _job_return(job: Job, value: float | None) -> JobReturn:
    returned = JobReturn(
        overrides=list(job.overrides),
        cfg=OmegaConf.masked_copy(job.config, [str(key) for key in job.config if key != "hydra"]),
        hydra_cfg=OmegaConf.masked_copy(job.config, "hydra"),
        working_dir=str(Path.cwd()),
        task_name=str(job.config.hydra.job.config_name),
    )
    if read_finished(job.folder) is not None:
        returned.status, returned.return_value = JobStatus.COMPLETED, value
    else:
        returned.status = JobStatus.FAILED
        returned.return_value = RaytranError(
            f"job {job.number} failed (see {job.folder / CONSOLE}): mend it and give the same command again, "
            "which runs only what has not finished"
        )
    return returned
