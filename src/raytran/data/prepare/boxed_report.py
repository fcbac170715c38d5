# SPDX-License-Identifier: Apache-2.0
"""The report of a preparation from boxes: what was prepared, what was left out and what is odd."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from raytran.data.prepare.annotation import Entry
from raytran.data.prepare.report import frame_counts, frame_lines, gigabytes, named, sizes
from raytran.data.prepare.scan import read_facts

_LEFT_OUT = {
    "scans_failed": "scans that cannot be used",
    "scans_without_boxes": "scans without a list of boxes",
    "boxes_without_scan": "lists of boxes without frames",
}
_NOTICED = {
    "categories_left_out": "scans with objects of other categories, which were left out",
    "objects_unseen": "scans with boxes that no camera sees",
    "objects_without_shape": "scans with objects of which nothing but the box is known",
    "meshes_outside_box": "scans with objects whose own mesh is not in their box, it was not used",
    "meshes_missing": "scans with meshes that are named and not there",
    "recordings_cut_short": "recordings that end early, the frames before were taken",
    "damaged_images": "scans with damaged images, others were taken",
}
_OF_OBJECTS = (
    *("categories_left_out", "objects_unseen", "objects_without_shape"),
    *("meshes_outside_box", "meshes_missing"),
)


def make_boxed_report(
    output: Path,
    entries: Mapping[str, Entry],
    splits: Mapping[str, Sequence[str]],
    left_out: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the content of ``report.json``; the same files give the same report.

    Args:
        output: the prepared folder.
        entries: annotation of all prepared scans.
        splits: prepared scans of each split.
        left_out: what was not prepared, by the keys of ``_LEFT_OUT``: names, or names with reasons.
    """
    facts = {scan: read_facts(output, scan) for scan in entries}
    noticed = {what: _of_scans(facts, what) for what in _OF_OBJECTS}
    return {
        "scans": {"prepared": len(facts)} | {split: len(names) for split, names in splits.items()},
        "objects": {split: _categories(entries, names) for split, names in splits.items()},
        "frames": frame_counts(facts),
        "size": sizes(output, facts),
        "left_out": {what: left_out.get(what, []) for what in _LEFT_OUT},
        "noticed": noticed
        | {
            "recordings_cut_short": {scan: f["cut"] for scan, f in facts.items() if f["cut"]},
            "damaged_images": {scan: f["damaged"] for scan, f in facts.items() if f["damaged"]},
        },
    }


def _of_scans(facts: Mapping[str, dict[str, Any]], what: str) -> dict[str, str]:
    """Return what was noticed of each scan's objects, in words."""
    noticed = {scan: f.get("noticed", {}).get(what) for scan, f in facts.items()}
    return {scan: ", ".join(names) for scan, names in noticed.items() if names}


def _categories(entries: Mapping[str, Entry], scans: Sequence[str]) -> dict[str, int]:
    models = (model for scan in scans for model in entries[scan]["aligned_models"])
    return dict(sorted(Counter(model["catid_cad"] for model in models).items()))


def boxed_report_text(report: Mapping[str, Any]) -> str:
    """Return the report as text; of many names the first few, the others are in ``report.json``."""
    left_out = [line for key, what in _LEFT_OUT.items() for line in named(what, report["left_out"][key])]
    noticed = [line for key, what in _NOTICED.items() for line in named(what, report["noticed"][key])]
    size = report["size"]
    counts = ", ".join(f"{split} {n}" for split, n in report["scans"].items() if split != "prepared")
    lines = [f"Scans    {report['scans']['prepared']} prepared: {counts}", *frame_lines(report["frames"])]
    lines += [
        f"Size     frames {gigabytes(size['color_bytes'])}, meshes {gigabytes(size['model_bytes'])}, "
        f"targets {gigabytes(size['target_bytes'])}",
        "",
        *_table(report["objects"]),
        "",
    ]
    lines += ["Left out", *(left_out or ["  nothing"]), "Noticed", *(noticed or ["  nothing"])]
    return "\n".join(lines) + "\n"


def _table(objects: Mapping[str, Mapping[str, int]]) -> Iterable[str]:
    """Return a row for each category and a column for each split."""
    names = sorted({name for column in objects.values() for name in column})
    width = max([11, *map(len, names)])
    yield "Objects  " + " " * width + "".join(f"{split:>8}" for split in objects)
    for name in names:
        yield f"         {name:<{width}}" + "".join(f"{c.get(name, 0):>8}" for c in objects.values())
    yield f"         {'all':<{width}}" + "".join(f"{sum(c.values()):>8}" for c in objects.values())
