# SPDX-License-Identifier: Apache-2.0
"""The report of a preparation: what was prepared, what was left out and why, beside the paper's counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import torch
from torch import Tensor

from raytran.classes import PAPER_CLASSES
from raytran.data.files import bytes_below
from raytran.data.prepare.annotation import Annotations, Entry, LeftOut
from raytran.data.prepare.scan import read_facts
from raytran.data.prepare.sources import Sources
from raytran.data.scan2cad import SceneAnnotation, parse_entry, scene_objects
from raytran.structs import ObjectSet

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


@dataclass(frozen=True)
class Outcome:
    """Which scans and objects a preparation used, and which not.

    Attributes:
        scans: all prepared scans, also those of earlier calls.
        entries: annotation of the prepared scans that have one.
        left_out: objects without a usable CAD file.
        without_objects: scans that are not prepared because none of their objects can be used.
        failed: scans that cannot be used, with the reason.
    """

    scans: Sequence[str]
    entries: Mapping[str, Entry]
    left_out: Sequence[LeftOut]
    without_objects: Sequence[str]
    failed: Mapping[str, str]


def make_report(
    output: Path, sources: Sources, outcome: Outcome, *, grid_extent: tuple[float, float, float]
) -> dict[str, Any]:
    """Return the content of ``report.json``; the same files give the same report.

    Args:
        output: the prepared folder.
        sources: what it was prepared from.
        outcome: which scans and objects were used.
        grid_extent: sizes of the volume, metres.
    """
    selection = sources.selection
    annotations = sources.annotations or Annotations()
    facts = {scan: read_facts(output, scan) for scan in outcome.scans}
    annotated = {scan: parse_entry(entry) for scan, entry in outcome.entries.items()}
    objects = {scan: scene_objects(annotation) for scan, annotation in annotated.items()}
    membership = {split: [s for s in listed if s in facts] for split, listed in selection.splits.items()}
    return {
        "scans": {"prepared": len(facts)} | {split: len(names) for split, names in membership.items()},
        "objects": _objects_by_class(objects, membership or {"all": list(facts)}),
        "frames": frame_counts(facts),
        "size": sizes(output, facts),
        "left_out": {
            "scans_failed": dict(sorted(outcome.failed.items())),
            "scans_without_annotation": selection.without_annotation,
            "scans_annotated_without_objects": sorted(annotations.empty),
            "scans_without_usable_objects": list(outcome.without_objects),
            "annotations_without_scan": selection.without_scan,
            "scans_in_no_split": selection.in_no_split,
            "objects": [asdict(item) for item in (*annotations.left_out, *outcome.left_out)],
        },
        "noticed": {
            "duplicate_scans": selection.duplicates,
            "duplicate_annotations": annotations.twice,
            "recordings_cut_short": _facts_with("cut", facts),
            "other_source_used": _facts_with("failed_sources", facts),
            **_odd_objects(annotated, objects, facts, grid_extent),
            "damaged_images": _facts_with("damaged", facts),
        },
    }


def _objects_by_class(
    objects: Mapping[str, ObjectSet], membership: Mapping[str, Sequence[str]]
) -> dict[str, dict[str, int]]:
    """Return the number of objects of each class, by split."""
    table = {}
    for split, scans in membership.items():
        labels = Counter(label for scan in scans if scan in objects for label in objects[scan].label.tolist())
        table[split] = {name: labels[index] for index, name in enumerate(PAPER_CLASSES.names)}
    return table


def frame_counts(facts: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Return how many frames scans had, were written and left out, by the facts of each scan."""
    reasons = Counter(reason for f in facts.values() for reason in f["dropped"].values())
    return {
        "in_scans": sum(f["frames"] for f in facts.values()),
        "written": sum(f["written"] for f in facts.values()),
        "dropped": dict(sorted(reasons.items())),
        "damaged_images": sum(len(f["damaged"]) for f in facts.values()),
        "stored_sizes": dict(
            sorted(Counter("x".join(map(str, f["stored_size"][::-1])) for f in facts.values()).items())
        ),
        "forms": dict(sorted(Counter(f["form"] for f in facts.values()).items())),
    }


def sizes(output: Path, facts: Mapping[str, dict[str, Any]]) -> dict[str, int]:
    """Return bytes of files; the many frames are not counted again, their scans' facts have the sum."""
    return {
        "color_bytes": sum(f["bytes"] for f in facts.values()),
        "model_bytes": bytes_below(output / "shapenet"),
        "target_bytes": bytes_below(output / "cache"),
    }


def _odd_objects(
    annotated: Mapping[str, SceneAnnotation],
    objects: Mapping[str, ObjectSet],
    facts: Mapping[str, dict[str, Any]],
    grid_extent: tuple[float, float, float],
) -> dict[str, dict[str, list[str]]]:
    """Return the models outside the volume around the cameras, mirrored, or without thickness, by scan."""
    half = torch.tensor(grid_extent, dtype=torch.float64) / 2
    odd: dict[str, dict[str, list[str]]] = {
        "objects_outside_volume": {},
        "objects_mirrored": {},
        "objects_flat": {},
    }
    for scan, annotation in annotated.items():
        volume_center = torch.tensor(facts[scan]["camera_center"], dtype=torch.float64)
        offset = (objects[scan].center.double() - volume_center).abs()
        is_mirrored = torch.linalg.det(annotation.scan_from_cad[:, :3, :3]) < 0
        is_flat = (annotation.box_half_size <= 0).any(dim=1)
        models = {
            "objects_outside_volume": _chosen(objects[scan].model_id, (offset > half).any(dim=1)),
            "objects_mirrored": _chosen(annotation.model_id, is_mirrored),
            "objects_flat": _chosen(annotation.model_id, is_flat),
        }
        for what, names in models.items():
            if names:
                odd[what][scan] = names
    return odd


def _chosen(names: Sequence[str], is_chosen: Tensor) -> list[str]:
    return [names[i] for i in is_chosen.nonzero().flatten().tolist()]


def _facts_with(key: str, facts: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the entry ``key`` of the scans in whose facts it is not empty."""
    return {scan: facts_of_scan[key] for scan, facts_of_scan in facts.items() if facts_of_scan[key]}


def report_text(report: Mapping[str, Any]) -> str:
    """Return the report as text; of many names the first few, the others are in ``report.json``."""
    left_out = [line for key, what in _LEFT_OUT.items() for line in named(what, report["left_out"][key])]
    left_out += _objects_left_out(report["left_out"]["objects"])
    noticed = [line for key, what in _NOTICED.items() for line in named(what, report["noticed"][key])]
    lines = [*_counts(report), "", *class_table(report["objects"]), ""]
    lines += ["Left out", *(left_out or ["  nothing"]), "Noticed", *(noticed or ["  nothing"])]
    return "\n".join(lines) + "\n"


def gigabytes(count: float) -> str:
    """Return a number of bytes as MB or GB."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"


def class_table(objects: Mapping[str, Mapping[str, int]]) -> Iterable[str]:
    """Return a table: a row for each class, a column for each split, and the paper's validation scans."""
    columns = dict(objects) | ({"val, paper": PAPER_VAL_OBJECTS} if "val" in objects else {})
    yield "Objects  " + " " * 11 + "".join(f"{name:>12}" for name in columns)
    for name in PAPER_CLASSES.names:
        yield f"         {name:<11}" + "".join(f"{column.get(name, '–'):>12}" for column in columns.values())
    yield f"         {'all':<11}" + "".join(f"{sum(column.values()):>12}" for column in columns.values())


def _counts(report: Mapping[str, Any]) -> Iterable[str]:
    scans, frames, size = report["scans"], report["frames"], report["size"]
    splits = ", ".join(
        f"{split} {count}{_paper(split)}" for split, count in scans.items() if split != "prepared"
    )
    yield f"Scans    {scans['prepared']} prepared" + (f": {splits}" if splits else ", no split files")
    yield from frame_lines(frames)
    yield (
        f"Size     frames {gigabytes(size['color_bytes'])}, CAD models {gigabytes(size['model_bytes'])}, "
        f"targets {gigabytes(size['target_bytes'])}"
    )


def frame_lines(frames: Mapping[str, Any]) -> Iterable[str]:
    """Return what is said of the frames: where from, how large, how many, and why not the others."""
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


def _paper(split: str) -> str:
    return f" (paper {PAPER_SCENES[split]})" if split in PAPER_SCENES else ""


def _objects_left_out(objects: Iterable[Mapping[str, str]]) -> list[str]:
    by_reason: dict[str, list[str]] = {}
    for item in objects:
        name = f"{item['scan']}: {item['model']}" if item["model"] else item["scan"]
        by_reason.setdefault(item["reason"], []).append(name)
    return [line for reason, names in by_reason.items() for line in named(f"objects, {reason}", names)]


def named(what: str, names: Sequence[str] | Mapping[str, Any]) -> list[str]:
    """Return a line with the count and lines with the first names, each with its reason if there is one."""
    if not names:
        return []
    reasons = names if isinstance(names, Mapping) else {}
    first = list(names)[:_NAMES_SHOWN]
    rest = [f"… and {len(names) - len(first)} more in report.json"] if len(names) > len(first) else []
    if any(isinstance(reasons.get(name), str) for name in first):
        lines = [*(f"{name}: {reasons[name]}" for name in first), *rest]
    else:
        text = ", ".join(first + rest)
        lines = fill(text, _WIDTH - 4, break_long_words=False, break_on_hyphens=False).splitlines()
    return [f"  {what}: {len(names)}", *(f"    {line}" for line in lines)]
