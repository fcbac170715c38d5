# SPDX-License-Identifier: Apache-2.0
"""The whole preparation of ScanNet + ShapeNet + Scan2CAD, to be given again after whatever ended it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from raytran.data.cache import file_digest
from raytran.data.files import UNFINISHED, sweep
from raytran.data.prepare.report_text import report_text
from raytran.data.prepare.scan import check_room
from raytran.data.prepare.settings import PrepareSettings, claimed
from raytran.data.prepare.sources import Released, read_sources
from raytran.data.prepare.steps import Preparation
from raytran.data.workers import work_on
from raytran.errors import DataError

_log = logging.getLogger(__name__)

_UNFINISHED = (
    f"{UNFINISHED}*",
    f"scannet/{UNFINISHED}*",
    f"scannet/scans/{UNFINISHED}*",
    f"scan2cad/{UNFINISHED}*",
    f"shapenet/*/{UNFINISHED}*",
    f"shapenet/*/*/{UNFINISHED}*",
    f"cache/*/*/{UNFINISHED}*",
)
"""Where processes that were killed leave temporary files."""


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

    A scan whose folder carries its final name is done; calling again does what is missing, and other scans
    may be asked for. The files written depend on nothing but the input and the settings.

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
            sweep(output, *_UNFINISHED)
            preparation.say_estimate(processes)
            report = preparation.run(grid_extent)
            sweep(output, *_UNFINISHED)
    except OSError as error:
        check_room(error, output)
        raise
    if not report["scans"]["prepared"]:
        raise _nothing_prepared(output, report)
    return Prepared(output, report, report_text(report))


def _nothing_prepared(output: Path, report: dict[str, Any]) -> DataError:
    failed = report["left_out"]["scans_failed"]
    why = next(iter(failed.values()), "none of their objects can be used")
    return DataError(f"no scan could be prepared ({why}); {output / 'report.txt'} names what was left out")
