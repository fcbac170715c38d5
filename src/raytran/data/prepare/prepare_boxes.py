# SPDX-License-Identifier: Apache-2.0
"""Prepares scans whose objects are annotated by boxes; goes on where a killed call stopped."""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from raytran.data.files import bytes_below, sweep, unfinished_name, write_json, write_text
from raytran.data.prepare.annotation import ANNOTATIONS, Entry
from raytran.data.prepare.boxed_report import boxed_report_text, make_boxed_report
from raytran.data.prepare.boxed_scan import (
    ENTRY,
    AnnotatedSource,
    is_prepared,
    prepare_boxed_scan,
    read_entry,
)
from raytran.data.prepare.estimate import Estimate
from raytran.data.prepare.prepare import UNFINISHED_FILES, Prepared, claimed
from raytran.data.prepare.scan import PrepareSettings, choose_frames, read_facts
from raytran.data.prepare.targets import check_disk
from raytran.data.scannet.find import SPLITS
from raytran.data.workers import work_on
from raytran.errors import ConfigError, DataError

_log = logging.getLogger(__name__)

_TRIED, _TRIED_FRAMES = 2, (2, 6)
"""Scans that are prepared for the estimate, and frames of each, first few and then more."""


def prepare_boxes(
    output: Path,
    sources: Sequence[AnnotatedSource],
    settings: PrepareSettings | None = None,
    *,
    left_out: Mapping[str, Any] | None = None,
    val_share: float = 0.2,
    seed: int = 0,
    processes: int = 0,
    progress: bool = True,
) -> Prepared:
    """Prepare scans whose objects are annotated by boxes, or go on with it.

    The folder is laid out as that of ``prepare_scan2cad``; in place of CAD models ``shapenet/`` has what
    stands in each box. A scan is done as long as its annotation stays; one whose annotation has changed is
    prepared anew. A further call may bring other scans.

    Args:
        output: folder that gets ``scannet/``, ``shapenet/``, ``scan2cad/``, ``cache/`` and the report.
        sources: the scans.
        settings: size and number of frames; None for the defaults.
        left_out: what is known not to be prepared, for the report, see ``make_boxed_report``.
        val_share: share of the scans that say no split which go into ``val``, at least one.
        seed: of their choice.
        processes: worker processes, 0 for one per core; 1 works in this process.
        progress: show progress bars.

    Raises:
        ConfigError: a setting makes no sense.
        DataError: ``output`` was begun otherwise, its disk is full, or no scan can be used.
    """
    output, settings = Path(output).resolve(), settings or PrepareSettings()
    if not 0 <= val_share < 1:
        raise ConfigError(f"val_share={val_share} is no share: give 0 or more, and less than 1")
    _log.info("found: scans %d with boxes", len(sources))
    try:
        with claimed(output, settings, {"targets": "boxes"}):
            sweep(output, *UNFINISHED_FILES)
            work = partial(work_on, processes=processes, progress=progress)
            failed = _prepare_scans(output, sources, settings, work, processes)
            report = _conclude(
                output, dict(left_out or {}) | {"scans_failed": failed}, val_share=val_share, seed=seed
            )
            sweep(output, *UNFINISHED_FILES)
    except OSError as error:
        check_disk(error, output)
        raise
    if not report["scans"]["prepared"]:
        why = next(iter(failed.values()), "there is none with boxes")
        raise DataError(f"no scan could be prepared: {why}")
    return Prepared(output, report, boxed_report_text(report))


def _prepare_scans(
    output: Path,
    sources: Sequence[AnnotatedSource],
    settings: PrepareSettings,
    work: Callable[..., Iterator[tuple[str, str | None]]],
    processes: int,
) -> dict[str, str]:
    """Prepare what is missing; return what is wrong with each scan that cannot be used."""
    missing = [source for source in sources if not is_prepared(source, output)]
    if missing:
        expected = _estimate(missing, output, settings, processes)
        _log.info("%s", expected)
        if expected.num_bytes > expected.free:
            _log.warning("the disk of %s will be full before that", output)
    prepare = partial(prepare_boxed_scan, output=output, settings=settings)
    return {scan: reason for scan, reason in work(missing, prepare, label="scans") if reason}


def _estimate(
    sources: Sequence[AnnotatedSource], output: Path, settings: PrepareSettings, processes: int
) -> Estimate:
    """Prepare a few frames of a few scans in a temporary folder, and extrapolate."""
    costs: list[tuple[float, float, int]] = []
    for i in choose_frames(len(sources), _TRIED):
        with suppress(DataError, OSError):
            few, more = (_trial(sources[i], output, settings, count) for count in _TRIED_FRAMES)
            frames = few.frames if settings.max_frames is None else min(few.frames, settings.max_frames)
            # What a scan costs without any frame, its meshes and its opening, and what each frame does.
            costs.append((*few.extrapolated(more, frames), frames))
    workers = min(processes or os.cpu_count() or 1, len(sources))
    num_bytes, seconds, frames = (
        (median(column) for column in zip(*costs, strict=True)) if costs else (0, 0, 0)
    )
    return Estimate(
        scans=len(sources),
        frames=round(frames * len(sources)),
        num_bytes=num_bytes * len(sources),
        seconds=seconds * len(sources) / workers,
        free=shutil.disk_usage(output).free,
    )


class _Trial(NamedTuple):
    """What it took to prepare some frames of a scan, and how many it has that are usable."""

    written: int
    num_bytes: int
    seconds: float
    frames: int

    def extrapolated(self, other: _Trial, count: int) -> tuple[float, float]:
        """Return bytes and seconds of ``count`` frames by two trials."""
        step = other.written - self.written
        if step <= 0:
            return other.num_bytes, other.seconds
        beyond = (count - self.written) / step
        return (
            self.num_bytes + beyond * max(0, other.num_bytes - self.num_bytes),
            self.seconds + beyond * max(0.0, other.seconds - self.seconds),
        )


def _trial(source: AnnotatedSource, output: Path, settings: PrepareSettings, count: int) -> _Trial:
    """Prepare at most ``count`` frames of a scan in a temporary folder.

    Raises:
        DataError: it cannot be prepared.
    """
    few = replace(settings, max_frames=min(count, settings.max_frames or count))
    with tempfile.TemporaryDirectory(prefix=f"{unfinished_name()}-", dir=output) as folder:
        started = time.perf_counter()
        _, reason = prepare_boxed_scan(source, Path(folder), few)
        if reason is not None:
            raise DataError(reason)
        seconds, facts = time.perf_counter() - started, read_facts(Path(folder), source.scene_id)
        frames = facts["frames"] - len(facts["dropped"])
        return _Trial(facts["written"], bytes_below(Path(folder)), seconds, frames)


def _conclude(output: Path, left_out: Mapping[str, Any], *, val_share: float, seed: int) -> dict[str, Any]:
    """Write annotation, splits and report of all prepared scans, also those of earlier calls."""
    folder = output / "scannet" / "scans"
    names = sorted(path.parent.name for path in folder.glob(f"[!.]*/{ENTRY}"))
    entries: dict[str, Entry] = {scan: read_entry(output, scan) for scan in names}
    write_text(output / "scan2cad" / ANNOTATIONS, json.dumps(list(entries.values())))
    given = {scan: read_facts(output, scan).get("split") for scan in names}
    splits = choose_splits(given, val_share=val_share, seed=seed)
    for split, scans in splits.items():
        write_text(output / "scannet" / f"scannetv2_{split}.txt", "".join(f"{scan}\n" for scan in scans))
    if entries and not splits["val"]:
        _log.warning("no scan is in the split val: train with data.val_split=train, or prepare more scans")
    report = make_boxed_report(output, entries, splits, left_out)
    write_json(output / "report.json", report)
    write_text(output / "report.txt", boxed_report_text(report))
    return report


def choose_splits(given: Mapping[str, str | None], *, val_share: float, seed: int) -> dict[str, list[str]]:
    """Return the scans of each split.

    Of the scans that say none the share ``val_share``, at least one of several, goes into ``val`` unless that
    has scans by their own word. Which ones depends on their names and the seed, not on their order.

    Args:
        given: the split of each scan, or None.
        val_share: share of the others.
        seed: of the choice.
    """
    splits = {split: [scan for scan, own in given.items() if own == split] for split in SPLITS}
    others = [scan for scan, own in given.items() if own is None]
    ordered = sorted(others, key=lambda scan: sha256(f"{seed} {scan}".encode()).hexdigest())
    count = round(val_share * len(others)) if others else 0
    if val_share and len(others) > 1 and not splits["val"]:
        count = max(count, 1)
    if splits["val"]:
        count = 0
    splits["val"] = sorted([*splits["val"], *ordered[:count]])
    splits["train"] = sorted([*splits["train"], *ordered[count:]])
    return {split: scans for split, scans in splits.items() if scans or split != "test"}
