# SPDX-License-Identifier: Apache-2.0
"""One self-contained HTML page: numbers, pictures and curves of a run, no scripts, no other files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from raytran.pictures.page import data_uri, write_page
from raytran.pictures.palette import class_hex
from raytran.structs import CLASSES

_MEDIA = {".png": "image/png", ".jpg": "image/jpeg"}


@dataclass(frozen=True)
class SplitScores:
    """Results on one set of rooms.

    Attributes:
        title: e.g. ``Training rooms``.
        meaning: one sentence that says what these numbers prove and what they do not.
        numbers: name of each headline number → its value as text.
        per_class: class name → (objects aligned, objects in all), the classes that occur.
    """

    title: str
    meaning: str
    numbers: Mapping[str, str]
    per_class: Mapping[str, tuple[int, int]]


@dataclass(frozen=True)
class Picture:
    """An image file (PNG or JPEG) and the sentence under it; ``wide`` ones take the whole row."""

    path: Path
    caption: str
    wide: bool = False


@dataclass(frozen=True)
class Section:
    """Pictures under a heading, with a sentence before them."""

    title: str
    text: str
    pictures: Sequence[Picture]


@dataclass(frozen=True)
class Report:
    """Content of the page.

    Attributes:
        title: heading.
        summary: one paragraph.
        splits: scores of each set of rooms.
        sections: pictures.
        steps: what was done and how many seconds it took, in order.
        files: what each file or folder holds → its path; shown relative to the page's folder.
        versions: name of each program → its version.
    """

    title: str
    summary: str
    splits: Sequence[SplitScores]
    sections: Sequence[Section]
    steps: Mapping[str, float]
    files: Mapping[str, Path]
    versions: Mapping[str, str]


def write_report(path: Path, report: Report) -> Path:
    """Write the page; pictures become part of it, so the file can be sent by itself.

    Args:
        path: HTML file; written whole or not at all.
        report: the content.

    Returns:
        ``path``.
    """
    seen = [name for name in CLASSES if any(name in split.per_class for split in report.splits)]
    return write_page(
        path,
        "report.html.j2",
        filters={"data_uri": _data_uri, "duration": _duration},
        report=report,
        classes=[(name, class_hex(CLASSES.index(name))) for name in seen],
        files={name: os.path.relpath(file, path.parent) for name, file in report.files.items()},
    )


def _data_uri(path: Path) -> str:
    return data_uri(path.read_bytes(), _MEDIA[path.suffix])


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"
