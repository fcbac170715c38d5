# SPDX-License-Identifier: Apache-2.0
"""The data doctor: are the scans in a folder right, and if not, what is to be done?"""

from __future__ import annotations

import fnmatch
import logging
from pathlib import Path

import numpy as np
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from raytran.capture.doctor.examine import Examination, examine
from raytran.capture.doctor.report import summary, write_doctor_page
from raytran.data.scan2cad import SceneAnnotation, read_annotations
from raytran.data.scannet.find import ScanSource, find_scans
from raytran.errors import ConfigError, DataError
from raytran.run.train.build import plain

_log = logging.getLogger(__name__)

ANNOTATIONS = "full_annotations.json"
_PARENTS = 4
"""How many folders above a scan its annotation is looked for: root/scannet/scans/<scan>."""


def check(cfg: DictConfig) -> bool:
    """Run ``raytran prepare check=DIR``; see ``conf/prepare.yaml``.

    Returns:
        whether nothing needs mending; the command exits with 1 otherwise.

    Raises:
        DataError: there is no scan.
        ConfigError: a setting makes no sense.
    """
    settings = plain(cfg)
    folder = Path(settings["check"])
    output = Path(settings.get("output") or f"doctor_{folder.resolve().name}.html")
    max_scans = settings["checks"]
    if max_scans < 1:
        raise ConfigError(f"checks={max_scans} is too few: give at least 1")
    across, along, up = (float(length) for length in settings["grid_extent"])
    named = {name: Path(settings[name]) for name in ("scan2cad", "shapenet") if settings.get(name)}
    examinations, num_found = check_folder(
        folder,
        scenes=settings.get("scenes"),
        max_scans=max_scans,
        grid_extent=(across, along, up),
        **named,
    )
    page = output if output.suffix == ".html" else output / "doctor.html"
    write_doctor_page(
        page, examinations, checked=folder, num_found=num_found, grid_extent=(across, along, up)
    )
    Console().print(_table(examinations))
    _log.info("%s", summary(examinations, folder, num_found))
    _log.info("wrote %s", page.resolve())
    if any(examination.faults for examination in examinations):
        raise SystemExit(1)
    return True


def check_folder(
    folder: Path,
    *,
    scenes: list[str] | None = None,
    max_scans: int = 10,
    grid_extent: tuple[float, float, float] = (9.0, 9.0, 3.5),
    scan2cad: Path | None = None,
    shapenet: Path | None = None,
) -> tuple[list[Examination], int]:
    """Examine the scans in a folder, or some of them, spread evenly.

    Args:
        folder: one scan, a folder of scans, or a data set with ``scannet``, ``shapenet`` and ``scan2cad``.
        scenes: names or patterns of the scans to examine; None: all.
        max_scans: examine no more than these many.
        grid_extent: of the model's volume, metres.
        scan2cad: annotation file or its folder; None: looked for around ``folder``.
        shapenet: folder of CADs; None: looked for around ``folder``.

    Returns:
        the examinations, and how many scans were found.

    Raises:
        DataError: there is no scan, or a named one is not there.
    """
    scans = find_scans(folder)
    if scenes:
        missing = [pattern for pattern in scenes if not fnmatch.filter(scans, pattern)]
        if missing:
            raise DataError(f"{missing[0]} is not among the {len(scans)} scans in {folder}: mend scenes=")
        scans = {name: scans[name] for pattern in scenes for name in fnmatch.filter(scans, pattern)}
    chosen = np.unique(np.linspace(0, len(scans) - 1, min(max_scans, len(scans))).round().astype(int))
    sources: list[ScanSource] = [list(scans.values())[i][0] for i in chosen.tolist()]
    annotations, shapenet = _annotations(folder, scan2cad), shapenet or _around(folder, "shapenet")
    console = Console(stderr=True)
    examinations = [
        examine(
            source,
            annotation=annotations.get(source.scene_id),
            shapenet_root=shapenet,
            grid_extent=grid_extent,
        )
        for source in track(sources, "examining", console=console, disable=not console.is_terminal)
    ]
    return examinations, len(scans)


def _annotations(folder: Path, given: Path | None) -> dict[str, SceneAnnotation]:
    """Return the scenes of the given annotation, or of one in or above the folder; empty if there is none."""
    if given is not None:
        return read_annotations(given / ANNOTATIONS if given.is_dir() else given)
    path = _around(folder, f"scan2cad/{ANNOTATIONS}") or _around(folder, ANNOTATIONS)
    return {} if path is None else read_annotations(path)


def _around(folder: Path, name: str) -> Path | None:
    """Return ``name`` in a folder or one of those above it."""
    folder = folder.resolve()
    candidates = (path / name for path in (folder, *folder.parents[:_PARENTS]))
    return next((path for path in candidates if path.exists()), None)


def _table(examinations: list[Examination]) -> Table:
    table = Table(title=None, show_lines=False)
    for name in ("scan", "check", "cause", "what to do"):
        table.add_column(name, overflow="fold")
    for examination in examinations:
        for finding in examination.faults:
            confidence = f" ({finding.confidence})" if finding.confidence else ""
            cause = f"{finding.cause}{confidence}"
            table.add_row(examination.scene_id, finding.check, cause, finding.fix or finding.text)
        if not examination.faults:
            unknown = [finding.check for finding in examination.findings if finding.state == "unknown"]
            text = f"cannot be told: {', '.join(unknown)}" if unknown else ""
            table.add_row(examination.scene_id, "all", "right", text)
    return table
