# SPDX-License-Identifier: Apache-2.0
"""The released files that a preparation is given, recognised and read as far as they are lists."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from raytran.data.prepare.annotation import Annotations, find_annotations, read_usable
from raytran.data.prepare.selection import Selection, select_scans
from raytran.data.scannet.find import ScanSource, find_scans, read_splits
from raytran.data.shapenet.models import Version, shapenet_version
from raytran.errors import ConfigError


@dataclass(frozen=True)
class Released:
    """Where the released files lie, and which of them to take.

    Attributes:
        scannet: folder with scans in any released form, however nested.
        shapenet: folder of ShapeNetCore, version 1 or 2; may be None if ``scan2cad`` is.
        scan2cad: ``full_annotations.json`` or a folder with it; None to prepare frames alone.
        scenes: names or patterns of scans; None for all.
        splits: of train, val and test.
    """

    scannet: Path
    shapenet: Path | None = None
    scan2cad: Path | None = None
    scenes: Sequence[str] | None = None
    splits: Sequence[str] = ("train", "val")


@dataclass(frozen=True)
class Sources:
    """What was recognised.

    Attributes:
        annotation_path: the annotation file; None if there is none.
        annotations: what can be used of it.
        shapenet: folder of the CAD models.
        version: which release of ShapeNetCore it is; None without one.
        listed: scans of each split file.
        selection: the scans to prepare.
    """

    annotation_path: Path | None
    annotations: Annotations | None
    shapenet: Path | None
    version: Version | None
    listed: Mapping[str, Sequence[str]]
    selection: Selection

    def __str__(self) -> str:
        jobs = self.selection.jobs
        counts = Counter(job.sources[0].form for job in jobs).most_common()
        forms = ", ".join(f"{form} {count}" for form, count in counts)
        models = "no CAD models" if self.version is None else f"ShapeNetCore {self.version}"
        return f"found: scans {len(jobs)} ({forms}); {models}; {self.annotation_path or 'no annotations'}"


def read_sources(released: Released, output: Path) -> Sources:
    """Find out what was given.

    Args:
        released: paths and choices.
        output: folder to leave out if it lies among the scans.

    Raises:
        ConfigError: the choices contradict each other.
        DataError: an input is missing, or no scan is left.
    """
    if released.scan2cad is not None and released.shapenet is None:
        raise ConfigError("annotations need CAD models: give shapenet=… beside scan2cad=…")
    path = None if released.scan2cad is None else find_annotations(released.scan2cad)
    annotations = None if path is None else read_usable(path)
    shapenet = released.shapenet if path else None
    version = None if shapenet is None else shapenet_version(shapenet)
    listed = read_splits(released.scannet)
    selection = select_scans(
        _outside(output, find_scans(released.scannet)),
        listed,
        annotations,
        root=released.scannet,
        scenes=released.scenes,
        splits=released.splits,
    )
    return Sources(path, annotations, shapenet, version, listed, selection)


def _outside(output: Path, found: Mapping[str, Sequence[ScanSource]]) -> dict[str, tuple[ScanSource, ...]]:
    others = {
        scan: tuple(s for s in sources if not s.path.resolve().is_relative_to(output))
        for scan, sources in found.items()
    }
    return {scan: sources for scan, sources in others.items() if sources}
