# SPDX-License-Identifier: Apache-2.0
"""The report of a preparation as text: counts beside the paper's, and names where something is wrong."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from textwrap import fill
from typing import Any

from raytran.structs import CLASSES

PAPER_SCENES = {"train": 1194, "val": 306}
"""Annotated scans of RayTran §4."""

PAPER_VAL_OBJECTS = {
    "bathtub": 120,
    "bookshelf": 212,
    "cabinet": 260,
    "chair": 1093,
    "display": 191,
    "sofa": 113,
    "table": 553,
    "trashbin": 232,
    "other": 410,
}
"""Objects of the validation scans, 3184 in all, derived from the accuracies of RayTran's Table 1."""

_NAMES_SHOWN = 5
_WIDTH = 100
_LEFT_OUT = {
    "scans_failed": "scans that cannot be read",
    "scans_without_annotation": "scans without annotation",
    "scans_annotated_without_objects": "scans annotated as empty",
    "scans_without_usable_objects": "scans none of whose objects can be used",
    "annotations_without_scan": "annotated scans that are not there",
    "scans_in_no_split": "scans in no split file",
}
_NOTICED = {
    "duplicate_scans": "scans found in several places, the first was taken",
    "duplicate_annotations": "scans annotated twice, the first entry was taken",
    "recordings_cut_short": "recordings that end early, the frames before were taken",
    "other_source_used": "scans whose best form cannot be read, another was taken",
    "damaged_images": "scans with damaged images, others were taken",
    "objects_outside_volume": "scans with objects outside the volume",
    "objects_mirrored": "scans with mirrored objects, see check=DIR",
    "objects_flat": "scans with objects that have no thickness, taken as 1 mm thick",
}


def report_text(report: Mapping[str, Any]) -> str:
    """Return the report as text; of many names the first few, the others are in ``report.json``."""
    left_out = [line for key, what in _LEFT_OUT.items() for line in _named(what, report["left_out"][key])]
    left_out += _objects_left_out(report["left_out"]["objects"])
    noticed = [line for key, what in _NOTICED.items() for line in _named(what, report["noticed"][key])]
    lines = [*_counts(report), "", *class_table(report["objects"]), ""]
    lines += ["Left out", *(left_out or ["  nothing"]), "Noticed", *(noticed or ["  nothing"])]
    return "\n".join(lines) + "\n"


def gigabytes(count: float) -> str:
    """Return a number of bytes as MB or GB."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"


def _counts(report: Mapping[str, Any]) -> Iterable[str]:
    scans, frames, size = report["scans"], report["frames"], report["size"]
    splits = ", ".join(
        f"{split} {count}{_paper(split)}" for split, count in scans.items() if split != "prepared"
    )
    yield f"Scans    {scans['prepared']} prepared" + (f": {splits}" if splits else ", no split files")
    for what in ("forms", "stored_sizes"):
        counts = ", ".join(f"{name} {count}" for name, count in frames[what].items())
        yield f"         {what.replace('_', ' ')}: {counts}"
    yield f"Frames   {frames['written']} written of {frames['in_scans']}"
    for reason, count in frames["dropped"].items():
        yield f"         {count} dropped: {reason}"
    others = (
        frames["in_scans"] - frames["written"] - sum(frames["dropped"].values()) - frames["damaged_images"]
    )
    if others:
        yield f"         {others} not taken because of max_frames"
    if frames["damaged_images"]:
        yield f"         {frames['damaged_images']} dropped: damaged image"
    yield (
        f"Size     frames {gigabytes(size['color_bytes'])}, CAD models {gigabytes(size['model_bytes'])}, "
        f"targets {gigabytes(size['target_bytes'])}"
    )


def _paper(split: str) -> str:
    return f" (paper {PAPER_SCENES[split]})" if split in PAPER_SCENES else ""


def class_table(objects: Mapping[str, Mapping[str, int]]) -> Iterable[str]:
    """Return a table: a row for each class, a column for each split, and the paper's validation scans."""
    columns = dict(objects) | ({"val, paper": PAPER_VAL_OBJECTS} if "val" in objects else {})
    yield "Objects  " + " " * 11 + "".join(f"{name:>12}" for name in columns)
    for name in CLASSES:
        yield f"         {name:<11}" + "".join(f"{column[name]:>12}" for column in columns.values())
    yield f"         {'all':<11}" + "".join(f"{sum(column.values()):>12}" for column in columns.values())


def _objects_left_out(objects: Iterable[Mapping[str, str]]) -> list[str]:
    by_reason: dict[str, list[str]] = {}
    for part in objects:
        name = f"{part['scan']}: {part['model']}" if part["model"] else part["scan"]
        by_reason.setdefault(part["reason"], []).append(name)
    return [line for reason, names in by_reason.items() for line in _named(f"objects, {reason}", names)]


def _named(what: str, names: Sequence[str] | Mapping[str, Any]) -> list[str]:
    """Return a line with the count, and the first names, with what is wrong with each where that is known."""
    if not names:
        return []
    known = names if isinstance(names, Mapping) else {}
    first = list(names)[:_NAMES_SHOWN]
    rest = [f"… and {len(names) - len(first)} more in report.json"] if len(names) > len(first) else []
    if any(isinstance(known.get(name), str) for name in first):
        lines = [*(f"{name}: {known[name]}" for name in first), *rest]
    else:
        text = ", ".join(first + rest)
        lines = fill(text, _WIDTH - 4, break_long_words=False, break_on_hyphens=False).splitlines()
    return [f"  {what}: {len(names)}", *(f"    {line}" for line in lines)]
