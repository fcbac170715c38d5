# SPDX-License-Identifier: Apache-2.0
"""The data doctor's page: what was found in each scan, what to do, and pictures that show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from raytran.capture.doctor.examine import Examination
from raytran.capture.doctor.figures import draw_frames, draw_plan, sight, telling_frames
from raytran.capture.doctor.finding import Finding
from raytran.pictures.page import data_uri, write_page

_FRAMES = 3
_PICTURED = 12
"""Scans that get pictures, those with faults first; a page of a thousand would not open."""

_WORDS = {"fault": "mend", "unknown": "not all told", "ok": "right"}


@dataclass(frozen=True)
class _Part:
    title: str
    plan: bytes
    frames: Sequence[tuple[str, bytes]]


@dataclass(frozen=True)
class _Row:
    scene_id: str
    state: str
    word: str
    causes: str


@dataclass(frozen=True)
class _ScanSection:
    scene_id: str
    facts: str
    faults: Sequence[Finding]
    findings: Sequence[Finding]
    parts: Sequence[_Part]


@dataclass(frozen=True)
class _Page:
    title: str
    summary: str
    rows: Sequence[_Row]
    scans: Sequence[_ScanSection]


def write_doctor_page(
    path: Path,
    examinations: Sequence[Examination],
    *,
    checked: Path,
    num_found: int,
    grid_extent: tuple[float, float, float],
) -> Path:
    """Write one HTML page that needs no other file; it appears whole or not at all.

    Args:
        path: the file.
        examinations: of each scan.
        checked: the folder that was given.
        num_found: scans in it, of which some may not have been examined.
        grid_extent: of the model's volume, metres.

    Returns:
        ``path``.
    """
    ordered = sorted(examinations, key=lambda examination: not examination.faults)
    sections = [
        _section(examination, grid_extent, pictured=i < _PICTURED) for i, examination in enumerate(ordered)
    ]
    page = _Page(
        title=f"Data doctor: {checked.resolve().name}",
        summary=summary(examinations, checked, num_found),
        rows=[_row(examination) for examination in ordered],
        scans=sections,
    )
    filters = {name: partial(data_uri, media=f"image/{name}") for name in ("png", "jpeg")}
    return write_page(path, "doctor.html.j2", filters=filters, page=page)


def summary(examinations: Sequence[Examination], checked: Path, num_found: int) -> str:
    """Return one or two sentences on all scans."""
    faulty = sum(1 for examination in examinations if examination.faults)
    looked = f"{len(examinations)} scan{'' if len(examinations) == 1 else 's'} of {checked}"
    if num_found > len(examinations):
        looked += f" (spread evenly over all {num_found}; checks=N looks at more)"
    if not faulty:
        return f"{looked}: nothing to mend was found."
    return f"{looked}: {faulty} {'has' if faulty == 1 else 'have'} something to mend."


def _row(examination: Examination) -> _Row:
    states = {finding.state for finding in examination.findings}
    state = next((state for state in ("fault", "unknown") if state in states), "ok")
    causes = "; ".join(finding.cause for finding in examination.faults)
    return _Row(examination.scene_id, state, _WORDS[state], causes)


def _section(examination: Examination, extent: tuple[float, float, float], *, pictured: bool) -> _ScanSection:
    recording = examination.recording
    facts = str(examination.path)
    parts: list[_Part] = []
    if recording is not None:
        height, width = recording.scan.image_size
        facts += (
            f": {len(recording)} frames of {width}x{height}, {len(examination.objects)} annotated objects, "
            f"{examination.matches} points matched, {examination.seconds:.1f} s"
        )
        if pictured:
            changes = examination.correction.changes_cameras
            title = "Cameras and boxes" if len(examination.objects) else "Cameras"
            parts = [_part(examination, extent, "As stored" if changes else title, False)]
            parts += [_part(examination, extent, "With the changes above", True)] if changes else []
    return _ScanSection(examination.scene_id, facts, examination.faults, examination.findings, parts)


def _part(examination: Examination, extent: tuple[float, float, float], title: str, corrected: bool) -> _Part:
    recording = examination.recording
    if recording is None:
        return _Part(title, b"", [])
    seen = sight(examination, recording, corrected=corrected)
    right = sight(examination, recording, corrected=True)
    frames = telling_frames(examination, right, recording.scan.image_size, _FRAMES)
    pictures = draw_frames(examination, recording, seen, frames)
    names = [recording.scan.frame_id[frame] for frame in frames]
    plan = draw_plan(examination, seen, extent)
    return _Part(title, plan, list(zip(names, pictures, strict=True)))
