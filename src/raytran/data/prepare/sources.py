# SPDX-License-Identifier: Apache-2.0
"""The released files that a preparation is given, and which of the scans among them it prepares."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from raytran.data.prepare.annotation import Annotations, Entry, find_annotations, read_usable
from raytran.data.prepare.scan import ScanJob
from raytran.data.scannet.find import SPLITS, ScanSource, find_scans, read_splits
from raytran.data.shapenet.models import Version, shapenet_version
from raytran.errors import ConfigError, DataError


@dataclass(frozen=True)
class Released:
    """Paths of the released files, and which scans to prepare from them.

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
class Selection:
    """The scans to prepare, and what the report says of the others.

    Attributes:
        jobs: the scans to prepare, in the order of their names.
        splits: scans of each split that was asked for, in the order of its file; empty without split files.
        without_annotation: scans on disk that have no annotation, so they are not prepared.
        without_scan: annotated scans of these splits that are not on disk.
        duplicates: paths of each scan that is on disk several times, the one that is taken first.
        in_no_split: scans on disk that no split file lists.
    """

    jobs: tuple[ScanJob, ...]
    splits: dict[str, list[str]]
    without_annotation: list[str]
    without_scan: list[str]
    duplicates: dict[str, list[str]]
    in_no_split: list[str]


@dataclass(frozen=True)
class Sources:
    """What the released files were recognised as.

    Attributes:
        annotation_path: the annotation file; None if there is none.
        annotations: its usable entries; None if there is no file.
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
    """Recognise the released files, and choose the scans to prepare.

    Args:
        released: paths and choices.
        output: the prepared folder, which is left out if it lies among the scans.

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


def _outside(output: Path, scans: Mapping[str, Sequence[ScanSource]]) -> dict[str, tuple[ScanSource, ...]]:
    """Return the sources of each scan that do not lie in the prepared folder."""
    others = {
        scan: tuple(source for source in sources if not source.path.resolve().is_relative_to(output))
        for scan, sources in scans.items()
    }
    return {scan: sources for scan, sources in others.items() if sources}


def select_scans(
    sources: Mapping[str, Sequence[ScanSource]],
    listed: Mapping[str, Sequence[str]],
    annotations: Annotations | None,
    *,
    root: Path,
    scenes: Sequence[str] | None,
    splits: Sequence[str],
) -> Selection:
    """Choose the scans to prepare.

    Scans named by ``scenes`` are prepared with or without annotation; all others only with one, unless there
    are no annotations at all.

    Args:
        sources: of each scan on disk, best first.
        listed: scans of each split file; empty if there are none, and then every scan counts.
        annotations: None if none are given.
        root: where scans were looked for.
        scenes: names or patterns such as ``scene01*``; None for all.
        splits: some of ``SPLITS``.

    Raises:
        ConfigError: an unknown split.
        DataError: a name in ``scenes`` matches nothing, or no scan is left.
    """
    unknown = set(splits) - set(SPLITS)
    if unknown:
        raise ConfigError(f"unknown splits {sorted(unknown)}: choose from {', '.join(SPLITS)}")
    lists = {split: list(listed.get(split, ())) for split in SPLITS if split in splits}
    in_scope = {scan for scans in lists.values() for scan in scans} if listed else set(sources)
    entries: Mapping[str, Entry] = {} if annotations is None else annotations.entries
    if scenes is not None:
        in_scope &= set(_named(scenes, [*sources, *entries], in_scope, root, splits))
    chosen = sorted(in_scope & set(sources))
    without_annotation = [scan for scan in chosen if annotations is not None and scan not in entries]
    skipped = without_annotation if scenes is None else []
    jobs = tuple(
        ScanJob(scan, tuple(sources[scan]), entries.get(scan)) for scan in chosen if scan not in skipped
    )
    if not jobs:
        raise _nothing_left(set(chosen), root)
    in_lists = {scan for scans in listed.values() for scan in scans}
    return Selection(
        jobs=jobs,
        splits=lists if listed else {},
        without_annotation=without_annotation,
        without_scan=sorted((in_scope if listed else set(entries)) & set(entries) - set(sources)),
        duplicates={
            scan: [_described(source, root) for source in sources[scan]]
            for scan in chosen
            if len(sources[scan]) > 1
        },
        in_no_split=sorted(set(sources) - in_lists) if listed else [],
    )


def _named(
    patterns: Sequence[str], known: Sequence[str], in_scope: set[str], root: Path, splits: Sequence[str]
) -> list[str]:
    """Return the scans that match; every pattern must match one of the splits that were asked for."""
    matches = {
        pattern: [scan for scan in dict.fromkeys(known) if fnmatchcase(scan, pattern)] for pattern in patterns
    }
    for pattern, scans in matches.items():
        if not scans:
            raise DataError(f"no scan in {root} or the annotations is called {pattern}: check scenes=")
        if not in_scope & set(scans):
            raise DataError(f"{pattern} is in none of splits=[{', '.join(splits)}]: add its split to splits=")
    return [scan for scans in matches.values() for scan in scans]


def _nothing_left(chosen: set[str], root: Path) -> DataError:
    if chosen:
        return DataError(
            f"none of the {len(chosen)} chosen scans in {root} has objects in the annotations: "
            "check that the files belong together"
        )
    return DataError(
        f"none of the scans that were asked for is in {root}: check scannet=, scenes= and splits="
    )


def _described(source: ScanSource, root: Path) -> str:
    """Return form and path of a source, for the report."""
    path = source.path
    return f"{source.form}: {path.relative_to(root) if path.is_relative_to(root) else path}"
