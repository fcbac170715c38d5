# SPDX-License-Identifier: Apache-2.0
"""Sweeps: each job is a command of its own, with its own world size, folder and GPUs.

Run inside one process, as Hydra's own launcher does it, a job on two devices leaves its rank behind, and
Lightning takes the next job for a part of the first.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import time
from collections import deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.utils import JobReturn, JobStatus, configure_log
from omegaconf import DictConfig, OmegaConf, open_dict

from raytran.checkpoints.runs import one_at_a_time, read_finished
from raytran.checkpoints.sweeps import RECORD, differences, read_record
from raytran.errors import ConfigError, RaytranError
from raytran.run.entry import typed_settings, user_environment
from raytran.run.refused_run import remove_refused_run
from raytran.run.sweep.faults import no_parent, said_by_all
from raytran.run.sweep.folder import THIS_SWEEP, own_settings, write_record
from raytran.run.sweep.job import CONSOLE, FAILED, FINISHED, STOPPED, Job
from raytran.run.sweep.progress import SweepProgress
from raytran.run.sweep.results import write_results
from raytran.training.callbacks.stop_signals import forward_signals

_log = logging.getLogger(__name__)

_NOT_FOR_A_JOB = {
    *("RANK", "LOCAL_RANK", "GLOBAL_RANK", "GROUP_RANK", "NODE_RANK", "ROLE_RANK", "WORLD_SIZE"),
    *("LOCAL_WORLD_SIZE", "GROUP_WORLD_SIZE", "ROLE_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"),
    *("SLURM_NTASKS", "SLURM_NTASKS_PER_NODE", "SLURM_PROCID", "SLURM_LOCALID"),
    *("PL_GLOBAL_SEED", "PL_SEED_WORKERS", "TORCHELASTIC_RUN_ID", THIS_SWEEP),
}
"""Environment variables that tell a process that it is one rank of several, which a job is not."""

_OF_TERMINALS = {"FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"}
"""Environment variables by which rich would draw bars into a file."""

_OF_SWEEPS = ("hydra.sweep", "hydra/sweep", "hydra.launcher", "hydra/launcher", "hydra.mode", "hydra.run.dir")
"""Settings of Hydra that are not for a single job."""

_POLL_SECONDS = 0.2


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
        ConfigError: the same sweep is running already, a setting makes no sense, or all jobs have the same
            fault.
        SystemExit: a signal has stopped the sweep; its jobs have got it too and have ended.
    """
    configure_log(config.hydra.hydra_logging, config.hydra.verbose)
    folder = Path(config.hydra.sweep.dir).absolute()
    # The jobs inherit the lock: a sweep is not taken up again while a job of a killed launcher still trains.
    with one_at_a_time(folder) as lock:
        jobs = _jobs(config, loader, job_overrides, folder)
        gpus = _gpus() if any(job.config.trainer.accelerator != "cpu" for job in jobs) else []
        refused = no_parent(jobs)
        if refused is None:
            typed = [str(item) for item in config.hydra.overrides.hydra]
            general = [item for item in typed if not item.lstrip("+~").startswith(_OF_SWEEPS)]
            stopped_by = run_jobs(jobs, gpus, general, lock, limit=_limit(parallel, jobs, gpus))
            values = write_results(folder, jobs)
    if refused is not None:
        remove_refused_run(folder, outputs=Path(jobs[0].config.outputs))
        raise refused
    if stopped_by:
        _log.info("stopped; the same command goes on with this sweep")
        raise SystemExit(128 + stopped_by)
    shared = said_by_all(jobs)
    if shared is not None:
        failed = [job for job in jobs if job.status == FAILED]
        raise ConfigError(f"{shared} ({_named(failed)} failed of this before the first step)")
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
    titles = differences(read_record(folder))
    for job in jobs:
        job.title = " ".join(titles[job.number])
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
    chosen = list({job.number: job for job in jobs}.values())  # a sampler may draw the same twice
    for job in chosen:
        if read_finished(job.folder) is None:
            waiting.append(job)
        else:
            job.status = FINISHED
            _log.info("job %d has finished before: %s", job.number, job.name)
    silent = any(job.config.get("progress_bar") == "none" for job in chosen)
    stopped_by = 0

    def stop(signum: int) -> None:
        """Let the jobs save themselves; the second signal ends them at once."""
        nonlocal stopped_by
        if not stopped_by:
            _log.info("stopping when the jobs have saved themselves; press Ctrl-C again to stop at once")
        for job in running:
            if job.process is None:
                continue
            if stopped_by:
                os.killpg(job.process.pid, signal.SIGKILL)
            else:
                job.process.send_signal(signal.SIGTERM)
        stopped_by = signum

    with forward_signals(stop), SweepProgress(chosen, silent=silent) as progress:
        while running or (waiting and not stopped_by):
            while waiting and not stopped_by and len(running) < limit:
                needed = waiting[0].gpus_needed(len(gpus))
                if needed > len(free):
                    break
                job = waiting.popleft()
                job.gpus = [free.pop(0) for _ in range(needed)]
                place = f"{len(chosen) - len(waiting)} of {len(chosen)}"
                _log.info("job %d starts: %s (%s, %s)", job.number, job.name, place, job.folder / CONSOLE)
                _start(job, general, lock, side_by_side=limit)
                running.append(job)
                progress.show(running)
            time.sleep(_POLL_SECONDS)
            for job in [job for job in running if job.process and job.process.poll() is not None]:
                running.remove(job)
                free += job.gpus
                _end(job, stopped=bool(stopped_by))
                progress.ended(job, running)
                if waiting and said_by_all(jobs) is not None:
                    _log.error("all fail of the same: %s will not start", _named(waiting))
                    waiting.clear()
            progress.look(running)
    return stopped_by


def _start(job: Job, general: Sequence[str], lock: int, *, side_by_side: int) -> None:
    environment = {name: value for name, value in user_environment().items() if name not in _NOT_FOR_A_JOB}
    if job.gpus:
        environment["CUDA_VISIBLE_DEVICES"] = ",".join(job.gpus)
    if side_by_side > 1:
        # Each would take all cores otherwise, and wait for the others most of the time.
        environment.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // side_by_side)))
    job.folder.mkdir(parents=True, exist_ok=True)
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
        _log.error("job %d failed with exit code %s: %s", job.number, code, job.said_last())


def _named(jobs: Iterable[Job]) -> str:
    """Return ``job 3`` or ``jobs 3, 4, 5``."""
    numbers = [str(job.number) for job in jobs]
    return f"job{'s' if len(numbers) > 1 else ''} {', '.join(numbers)}"


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


class _Return(JobReturn):
    """What Hydra gets of a job, without the line that it would write of one that has failed."""

    @property
    def return_value(self) -> Any:
        """Return what the job has come to, or raise why it has not.

        Raises:
            RaytranError: the job failed.
        """
        if isinstance(self._return_value, Exception):
            raise self._return_value
        return self._return_value

    @return_value.setter
    def return_value(self, value: Any) -> None:
        """Take it."""
        self._return_value = value


def _job_return(job: Job, value: float | None) -> JobReturn:
    returned = _Return(
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
