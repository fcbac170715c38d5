# SPDX-License-Identifier: Apache-2.0
"""The steps of a preparation: estimate, models, scans, lists, report."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from raytran.data.files import write_json, write_text
from raytran.data.prepare.annotation import ANNOTATIONS, Entry, used_models, without_models
from raytran.data.prepare.estimate import estimate
from raytran.data.prepare.models import prepare_model
from raytran.data.prepare.report import Outcome, make_report
from raytran.data.prepare.report_text import report_text
from raytran.data.prepare.scan import ScanJob, prepare_scan, scan_folder
from raytran.data.prepare.settings import PrepareSettings
from raytran.data.prepare.sources import Sources
from raytran.data.shapenet.models import has_model

_log = logging.getLogger(__name__)


@dataclass
class Preparation:
    """The steps, each of which leaves alone what is done.

    Attributes:
        output: the prepared folder, claimed.
        settings: of the preparation.
        sources: what to prepare.
        work: ``work_on`` with its processes chosen.
    """

    output: Path
    settings: PrepareSettings
    sources: Sources
    work: Callable[..., Iterator[tuple[str, str | None]]]

    def say_estimate(self, processes: int) -> None:
        """Log how large and how long what is missing will be."""
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
            said = estimate(
                jobs, models, self.output, self.settings, shapenet=self.sources.shapenet, processes=processes
            )
            _log.info("%s", said)
            if said.num_bytes > said.free:
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
        found = folder.iterdir() if folder.is_dir() else ()
        return sorted(path.name for path in found if not path.name.startswith("."))

    def _entries(self) -> dict[str, Entry]:
        """Return the annotation of all scans that are to be prepared or are."""
        known = {} if self.sources.annotations is None else self.sources.annotations.entries
        wanted = {job.scene_id for job in self.sources.selection.jobs} | set(self._finished())
        return {scan: known[scan] for scan in sorted(wanted & known.keys())}

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
            kept = [entries[scan] for scan in scans if scan in entries]
            write_text(self.output / "scan2cad" / ANNOTATIONS, json.dumps(kept))
        for split, names in self.sources.listed.items():
            there = [scan for scan in names if scan in present]
            if there or split in self.sources.selection.splits:
                lines = "".join(f"{scan}\n" for scan in there)
                write_text(self.output / "scannet" / f"scannetv2_{split}.txt", lines)
