# SPDX-License-Identifier: Apache-2.0
"""Sweeps: each job is a command of its own, so nothing of one reaches the next.

Run inside one process, as Hydra's own launcher does it, a job on two devices leaves its rank behind, and
Lightning takes the next job for a part of the first.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from pathlib import Path

from hydra.core.config_loader import ConfigLoader
from hydra.core.utils import JobReturn, JobStatus, configure_log
from omegaconf import DictConfig, OmegaConf, open_dict

from raytran.checkpoints.runs import one_at_a_time
from raytran.errors import ConfigError, RaytranError
from raytran.run.sweep.folder import RECORD, own_settings, read_record, write_record
from raytran.run.sweep.jobs import CONSOLE, Job, JobPool
from raytran.run.sweep.table import FINISHED, FINISHED_BEFORE, JobResult, report

_log = logging.getLogger(__name__)

_OF_SWEEPS = ("hydra.sweep", "hydra/sweep", "hydra.launcher", "hydra/launcher", "hydra.mode", "hydra.run.dir")
"""Settings of Hydra that are not for a single job."""


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
        pool = JobPool(_limit(parallel, jobs, gpus), gpus, _general(config), lock)
        results = pool.run(jobs)
        report(folder, results)
    if pool.stopped_by is not None:
        _log.info("stopped; the same command goes on with this sweep")
        raise SystemExit(128 + pool.stopped_by)
    return [_job_return(job, result) for job, result in zip(jobs, results, strict=True)]


def _jobs(
    config: DictConfig, loader: ConfigLoader, job_overrides: Sequence[Sequence[str]], folder: Path
) -> list[Job]:
    """Return the jobs with their folders: those known from before keep theirs."""
    known = read_record(folder)["jobs"] if (folder / RECORD).is_file() else []
    found: list[tuple[int, tuple[str, ...], DictConfig]] = []
    for overrides in job_overrides:
        settings = own_settings(overrides)
        number = next((i for i, job in enumerate(known) if job["overrides"] == settings), len(known))
        composed = loader.load_sweep_config(config, list(overrides))
        with open_dict(composed):
            composed.hydra.job.num, composed.hydra.job.id = number, str(number)
        if int(composed.trainer.num_nodes) > 1:
            raise ConfigError("jobs on several machines need a cluster's queue: hydra/launcher=slurm")
        if number == len(known):
            known.append({"overrides": settings, "folder": str(composed.hydra.sweep.subdir)})
        found.append((number, tuple(overrides), composed))
    program, typed = config.hydra.job.config_name, [str(item) for item in config.hydra.overrides.task]
    write_record(folder, program, typed, known)
    shared = set.intersection(*(set(job["overrides"]) for job in known)) if len(known) > 1 else set()
    return [
        Job(
            number=number,
            overrides=overrides,
            folder=folder / known[number]["folder"],
            config=composed,
            program=program,
            title=" ".join(item for item in own_settings(overrides) if item not in shared),
        )
        for number, overrides, composed in found
    ]


def _general(config: DictConfig) -> list[str]:
    """Return what was typed for Hydra itself and concerns a single job."""
    typed = [str(item) for item in config.hydra.overrides.hydra]
    return [item for item in typed if not item.lstrip("+~").startswith(_OF_SWEEPS)]


def _gpus() -> list[str]:
    """Return the names of this machine's GPUs as CUDA_VISIBLE_DEVICES wants them."""
    import torch

    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(index) for index in range(torch.cuda.device_count())]
    return names if torch.cuda.is_available() else []


def _limit(parallel: int | str, jobs: Sequence[Job], gpus: Sequence[str]) -> int:
    if parallel == "auto":
        return max(1, len(gpus)) if any(job.gpus(len(gpus)) for job in jobs) else 1
    try:
        limit = int(parallel)
    except ValueError:
        limit = 0
    if limit < 1:
        raise ConfigError(f"launcher.parallel must be auto or at least 1, got {parallel}")
    return limit


def _job_return(job: Job, result: JobResult) -> JobReturn:
    hydra_config = OmegaConf.masked_copy(job.config, "hydra")
    returned = JobReturn(
        overrides=list(job.overrides),
        cfg=OmegaConf.masked_copy(job.config, [str(key) for key in job.config if key != "hydra"]),
        hydra_cfg=hydra_config,
        working_dir=str(Path.cwd()),
        task_name=job.program,
    )
    if result.status in (FINISHED, FINISHED_BEFORE):
        returned.status, returned.return_value = JobStatus.COMPLETED, result.value
    else:
        returned.status = JobStatus.FAILED
        returned.return_value = RaytranError(
            f"job {job.number} failed (see {job.folder / CONSOLE}): mend it and give the same command again, "
            "which runs only what has not finished"
        )
    return returned
