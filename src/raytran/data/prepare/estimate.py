# SPDX-License-Identifier: Apache-2.0
"""Estimates disk space and time of a preparation from a few real frames and models before it starts."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean, median

from raytran.data.files import bytes_below, unfinished_name
from raytran.data.prepare.annotation import used_models, without_models
from raytran.data.prepare.report import gigabytes
from raytran.data.prepare.scan import PrepareSettings, ScanJob, choose_frames, encoded_frame
from raytran.data.prepare.targets import prepare_model, write_masks
from raytran.errors import DataError

_SAMPLES = 3
"""Number of models, of scans, and of frames of each of these scans that are prepared for the estimate."""

_SCANS_COUNTED = 50
"""Number of scans whose frames are counted."""


@dataclass(frozen=True)
class Estimate:
    """What a preparation has still to do.

    Attributes:
        scans: to prepare.
        frames: to write.
        num_bytes: that will be written.
        seconds: on this machine, with the processes that were asked for.
        free: bytes that the disk has left.
    """

    scans: int
    frames: int
    num_bytes: float
    seconds: float
    free: int

    def __str__(self) -> str:
        minutes = self.seconds / 60
        duration = f"{minutes / 60:.1f} h" if minutes > 90 else f"{max(minutes, 1):.0f} min"
        return (
            f"to do: scans {self.scans}, frames about {self.frames}; expect {gigabytes(self.num_bytes)} "
            f"on disk ({gigabytes(self.free)} are free) and {duration}"
        )


def estimate(
    jobs: Sequence[ScanJob],
    models: Sequence[str],
    output: Path,
    settings: PrepareSettings,
    *,
    shapenet: Path | None,
    processes: int,
) -> Estimate:
    """Prepare a few frames and models in a temporary folder, and extrapolate.

    Args:
        jobs: the scans that are not done.
        models: ``catid/id`` of the CAD models that are not done.
        output: the prepared folder; it exists.
        settings: of the preparation.
        shapenet: folder of CAD models; None for none.
        processes: as for ``work_on``.
    """
    counts = [_num_frames(jobs[i], settings) for i in choose_frames(len(jobs), _SCANS_COUNTED)]
    frames = round(fmean(counts) * len(jobs)) if counts else 0
    with tempfile.TemporaryDirectory(prefix=f"{unfinished_name()}-", dir=output) as folder:
        trial = Path(folder)
        model_cost = frame_cost = (0.0, 0.0)
        if shapenet is not None:
            some_models = [models[i] for i in choose_frames(len(models), _SAMPLES)]
            model_cost = _median_cost(partial(_model_cost, model, shapenet, trial) for model in some_models)
        some_jobs = [jobs[i] for i in choose_frames(len(jobs), _SAMPLES)]
        frame_cost = _median_cost(partial(_frame_cost, job, settings, shapenet, trial) for job in some_jobs)
    workers = min(processes or os.cpu_count() or 1, max(len(jobs), 1))
    return Estimate(
        scans=len(jobs),
        frames=frames,
        num_bytes=frame_cost[0] * frames + model_cost[0] * len(models),
        seconds=(frame_cost[1] * frames + model_cost[1] * len(models)) / workers,
        free=shutil.disk_usage(output).free,
    )


def _num_frames(job: ScanJob, settings: PrepareSettings) -> int:
    with suppress(DataError):
        count = job.sources[0].num_frames
        return count if settings.max_frames is None else min(count, settings.max_frames)
    return 0


def _median_cost(trials: Iterable[Callable[[], tuple[float, float]]]) -> tuple[float, float]:
    """Return the median bytes and the median seconds of trials; trials that fail do not count."""
    costs = []
    for trial in trials:
        with suppress(DataError, OSError):
            costs.append(trial())
    return (median(b for b, _ in costs), median(s for _, s in costs)) if costs else (0.0, 0.0)


def _model_cost(model_id: str, shapenet: Path, trial: Path) -> tuple[float, float]:
    """Return bytes and seconds of a CAD model."""
    before, started = bytes_below(trial), time.perf_counter()
    _, reason = prepare_model(model_id, shapenet, trial)
    if reason is not None:
        raise DataError(reason)
    return bytes_below(trial) - before, time.perf_counter() - started


def _frame_cost(
    job: ScanJob, settings: PrepareSettings, shapenet: Path | None, trial: Path
) -> tuple[float, float]:
    """Return bytes and seconds of one frame, with its mask."""
    entry = job.entry if settings.masks and shapenet is not None else None
    if entry is not None and shapenet is not None:
        done = dict(prepare_model(model, shapenet, trial) for model in used_models([entry]))
        entry, _ = without_models(entry, {model: reason for model, reason in done.items() if reason})
    before, started = bytes_below(trial), time.perf_counter()
    with job.sources[0].open() as scan:
        chosen = choose_frames(len(scan), _SAMPLES)
        written = sum(len(encoded_frame(scan, position, settings.image_size)[0]) for position in chosen)
        if entry is not None:
            write_masks(entry, scan.cameras[chosen].scaled_to(settings.image_size), trial)
    seconds = time.perf_counter() - started
    return (written + bytes_below(trial) - before) / len(chosen), seconds / len(chosen)
