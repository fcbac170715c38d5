# SPDX-License-Identifier: Apache-2.0
"""Prepares ScanNet, ShapeNet and Scan2CAD as released for training; goes on where a killed call stopped."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from raytran.data.cache import file_digest
from raytran.data.files import UNFINISHED, SettingsRecord, sweep, write_json, write_text
from raytran.data.locks import exclusive_lock
from raytran.data.prepare.annotation import ANNOTATIONS, Entry, used_models, without_models
from raytran.data.prepare.estimate import estimate
from raytran.data.prepare.report import Outcome, make_report, report_text
from raytran.data.prepare.scan import PrepareSettings, ScanJob, prepare_scan, scan_folder
from raytran.data.prepare.sources import Released, Sources, read_sources
from raytran.data.prepare.targets import check_disk, prepare_model
from raytran.data.shapenet.models import has_model
from raytran.data.workers import work_on
from raytran.errors import DataError

_log = logging.getLogger(__name__)

FORMAT = "raytran.prepared/1"
"""Rises when the same files no longer give the same folder."""

MARKER = "prepare.json"
"""File with the settings that a prepared folder was begun with."""

_LOCK = ".prepare.lock"
UNFINISHED_FILES = (
    f"{UNFINISHED}*",
    f"scannet/{UNFINISHED}*",
    f"scannet/scans/{UNFINISHED}*",
    f"scan2cad/{UNFINISHED}*",
    f"shapenet/*/{UNFINISHED}*",
    f"shapenet/*/*/{UNFINISHED}*",
    f"cache/*/*/{UNFINISHED}*",
)
"""Where processes that were killed leave temporary files and folders."""


@dataclass(frozen=True)
class Prepared:
    """A prepared folder.

    Attributes:
        root: the folder.
        report: what ``report.json`` says.
        text: what ``report.txt`` says.
    """

    root: Path
    report: dict[str, Any]
    text: str


def prepare_scan2cad(
    output: Path,
    released: Released,
    settings: PrepareSettings | None = None,
    *,
    grid_extent: tuple[float, float, float] = (9.0, 9.0, 3.5),
    processes: int = 0,
    progress: bool = True,
) -> Prepared:
    """Prepare ScanNet's scans with Scan2CAD's annotation and ShapeNet's models, or go on with it.

    A scan whose folder has its final name is done. A further call does what is missing, and may ask for other
    scans. The files written depend on nothing but the input and the settings.

    Args:
        output: folder that gets ``scannet/``, ``shapenet/``, ``scan2cad/``, ``cache/`` and the report.
        released: the input.
        settings: size and number of frames; None for the defaults.
        grid_extent: sizes of the volume, metres, to count objects outside of it.
        processes: worker processes, 0 for one per core; 1 works in this process.
        progress: show progress bars.

    Raises:
        ConfigError: the arguments contradict each other.
        DataError: an input is missing, ``output`` was begun otherwise, its disk is full, or no scan can be
            used.
    """
    output, settings = Path(output).resolve(), settings or PrepareSettings()
    sources = read_sources(released, output)
    _log.info("%s", sources)
    path = sources.annotation_path
    work = partial(work_on, processes=processes, progress=progress)
    preparation = Preparation(output, settings, sources, work)
    try:
        with claimed(output, settings, {"annotations": None if path is None else file_digest(path)}):
            sweep(output, *UNFINISHED_FILES)
            preparation.log_estimate(processes)
            report = preparation.run(grid_extent)
            sweep(output, *UNFINISHED_FILES)
    except OSError as error:
        check_disk(error, output)
        raise
    if not report["scans"]["prepared"]:
        raise _nothing_prepared(output, report)
    return Prepared(output, report, report_text(report))


def _nothing_prepared(output: Path, report: dict[str, Any]) -> DataError:
    failed = report["left_out"]["scans_failed"]
    why = next(iter(failed.values()), "none of their objects can be used")
    return DataError(f"no scan could be prepared ({why}); {output / 'report.txt'} names what was left out")


@contextmanager
def claimed(output: Path, settings: PrepareSettings, sources: dict[str, Any]) -> Iterator[None]:
    """Lock ``output`` for the block; it is new, or was begun with the same settings and input.

    Args:
        output: the prepared folder; made if it is missing.
        settings: of the preparation.
        sources: digests of the input.

    Raises:
        DataError: it was begun with others, holds other things, or another process works on it.
    """
    record = SettingsRecord(output / MARKER)
    is_new = not record.path.exists() and output.exists()
    if is_new and any(not entry.name.startswith(".") for entry in output.iterdir()):
        raise DataError(
            f"{output} holds other things than prepared data: choose a folder that does not exist yet"
        )
    with exclusive_lock(output / _LOCK, if_taken=partial(_taken, output)):
        different = record.begin({"format": FORMAT, **asdict(settings), **sources})
        if different:
            raise DataError(
                f"{record.path} says that the folder was begun with another {', '.join(different)}; "
                "choose another output folder or remove this one"
            )
        yield


def _taken(output: Path, who: str) -> DataError:
    return DataError(
        f"another process prepares {output} ({who}): wait for it to end, or choose another folder"
    )


@dataclass
class Preparation:
    """The steps of a preparation; each does only what is not done yet.

    Attributes:
        output: the prepared folder, locked.
        settings: of the preparation.
        sources: what to prepare.
        work: ``work_on`` with its processes chosen.
    """

    output: Path
    settings: PrepareSettings
    sources: Sources
    work: Callable[..., Iterator[tuple[str, str | None]]]

    def log_estimate(self, processes: int) -> None:
        """Log how much disk space and time the scans and models that are missing will take."""
        jobs = [
            job for job in self.sources.selection.jobs if not scan_folder(self.output, job.scene_id).is_dir()
        ]
        copies = self.output / "shapenet"
        models = [
            model
            for model in used_models(self._entries().values())
            if not has_model(copies, *model.split("/"))
        ]
        if jobs:
            expected = estimate(
                jobs, models, self.output, self.settings, shapenet=self.sources.shapenet, processes=processes
            )
            _log.info("%s", expected)
            if expected.num_bytes > expected.free:
                _log.warning("the disk of %s will be full before that", self.output)

    def run(self, grid_extent: tuple[float, float, float]) -> dict[str, Any]:
        """Do everything and return the report."""
        entries, left_out = self._entries(), []
        broken = self._copy_models(used_models(entries.values()))
        for scan, entry in entries.items():
            entries[scan], without_cad = without_models(entry, broken)
            left_out += without_cad
        without_objects = sorted(scan for scan, entry in entries.items() if not entry["aligned_models"])
        entries = {scan: entry for scan, entry in entries.items() if scan not in without_objects}
        jobs = [
            replace(job, entry=entries.get(job.scene_id))
            for job in self.sources.selection.jobs
            if job.scene_id not in without_objects
        ]
        failed = self._prepare_scans(jobs)
        scans = self._finished()
        self._write_lists(scans, entries)
        prepared = {scan: entries[scan] for scan in scans if scan in entries}
        outcome = Outcome(scans, prepared, left_out, without_objects, failed)
        report = make_report(self.output, self.sources, outcome, grid_extent=grid_extent)
        write_json(self.output / "report.json", report)
        write_text(self.output / "report.txt", report_text(report))
        return report

    def _finished(self) -> list[str]:
        """Return the prepared scans, also those of earlier calls."""
        folder = self.output / "scannet" / "scans"
        paths = folder.iterdir() if folder.is_dir() else ()
        return sorted(path.name for path in paths if not path.name.startswith("."))

    def _entries(self) -> dict[str, Entry]:
        """Return the annotation of all scans that are to be prepared or are."""
        entries = {} if self.sources.annotations is None else self.sources.annotations.entries
        scans = {job.scene_id for job in self.sources.selection.jobs} | set(self._finished())
        return {scan: entries[scan] for scan in sorted(scans & entries.keys())}

    def _copy_models(self, models: Sequence[str]) -> dict[str, str]:
        """Return what is wrong with each CAD model that cannot be used."""
        if self.sources.shapenet is None:
            return {}
        copy = partial(prepare_model, source=self.sources.shapenet, output=self.output)
        return {
            model: reason
            for model, reason in self.work(models, copy, label="models", items_each=20)
            if reason
        }

    def _prepare_scans(self, jobs: Sequence[ScanJob]) -> dict[str, str]:
        """Return what is wrong with each scan that cannot be used."""
        prepare = partial(prepare_scan, output=self.output, settings=self.settings)
        return {scan: reason for scan, reason in self.work(jobs, prepare, label="scans") if reason}

    def _write_lists(self, scans: Sequence[str], entries: Mapping[str, Entry]) -> None:
        """Write the annotation and the split files of the prepared scans."""
        present = set(scans)
        if self.sources.annotations is not None:
            prepared = [entries[scan] for scan in scans if scan in entries]
            write_text(self.output / "scan2cad" / ANNOTATIONS, json.dumps(prepared))
        for split, names in self.sources.listed.items():
            listed = [scan for scan in names if scan in present]
            if listed or split in self.sources.selection.splits:
                lines = "".join(f"{scan}\n" for scan in listed)
                write_text(self.output / "scannet" / f"scannetv2_{split}.txt", lines)
