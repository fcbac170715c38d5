# SPDX-License-Identifier: Apache-2.0
"""What a prepared folder holds and what was left out of it, as numbers, as names, and as text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from raytran.data.files import bytes_below
from raytran.data.prepare.annotation import Annotations, Entry, LeftOut
from raytran.data.prepare.scan import read_facts
from raytran.data.prepare.sources import Sources
from raytran.data.scan2cad import SceneAnnotation, parse_entry, scene_objects
from raytran.structs import CLASSES, ObjectSet


@dataclass(frozen=True)
class Outcome:
    """What a preparation led to.

    Attributes:
        scans: prepared scans, those of earlier calls among them.
        entries: annotation of those that have one.
        left_out: objects without a usable CAD file.
        without_objects: scans that are not prepared because none of their objects can be used.
        failed: scans that cannot be used, and why.
    """

    scans: Sequence[str]
    entries: Mapping[str, Entry]
    left_out: Sequence[LeftOut]
    without_objects: Sequence[str]
    failed: Mapping[str, str]


def make_report(
    output: Path, sources: Sources, outcome: Outcome, *, grid_extent: tuple[float, float, float]
) -> dict[str, Any]:
    """Collect what is known about a prepared folder; the same files give the same report.

    Args:
        output: the prepared folder.
        sources: what it was prepared from.
        outcome: what became of it.
        grid_extent: sizes of the volume, metres.
    """
    selection, found = sources.selection, sources.annotations or Annotations()
    facts = {scan: read_facts(output, scan) for scan in outcome.scans}
    annotated = {scan: parse_entry(entry) for scan, entry in outcome.entries.items()}
    objects = {scan: scene_objects(annotation) for scan, annotation in annotated.items()}
    membership = {split: [s for s in listed if s in facts] for split, listed in selection.splits.items()}
    return {
        "scans": {"prepared": len(facts)} | {split: len(names) for split, names in membership.items()},
        "objects": _objects_by_class(objects, membership or {"all": list(facts)}),
        "frames": _frames(facts),
        "size": _sizes(output, facts),
        "left_out": {
            "scans_failed": dict(sorted(outcome.failed.items())),
            "scans_without_annotation": selection.without_annotation,
            "scans_annotated_without_objects": sorted(found.empty),
            "scans_without_usable_objects": list(outcome.without_objects),
            "annotations_without_scan": selection.without_scan,
            "scans_in_no_split": selection.in_no_split,
            "objects": [asdict(part) for part in (*found.left_out, *outcome.left_out)],
        },
        "noticed": {
            "duplicate_scans": selection.duplicates,
            "duplicate_annotations": found.twice,
            "recordings_cut_short": _facts_that_say("cut", facts),
            "other_source_used": _facts_that_say("failed_sources", facts),
            "objects_outside_volume": _outside(facts, objects, grid_extent),
            "objects_mirrored": _where(annotated, _is_mirrored),
            "objects_flat": _where(annotated, _is_flat),
            "damaged_images": _facts_that_say("damaged", facts),
        },
    }


def _facts_that_say(key: str, facts: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    return {scan: f[key] for scan, f in facts.items() if f[key]}


def _objects_by_class(
    objects: Mapping[str, ObjectSet], membership: Mapping[str, Sequence[str]]
) -> dict[str, dict[str, int]]:
    """Return the number of objects of each class, by split."""
    table = {}
    for split, scans in membership.items():
        labels = Counter(label for scan in scans if scan in objects for label in objects[scan].label.tolist())
        table[split] = {name: labels[index] for index, name in enumerate(CLASSES)}
    return table


def _frames(facts: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
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


def _sizes(output: Path, facts: Mapping[str, dict[str, Any]]) -> dict[str, int]:
    """Return bytes of files; those of the frames from the scans' facts, for there are many."""
    return {
        "color_bytes": sum(f["bytes"] for f in facts.values()),
        "model_bytes": bytes_below(output / "shapenet"),
        "target_bytes": bytes_below(output / "cache"),
    }


def _outside(
    facts: Mapping[str, dict[str, Any]], objects: Mapping[str, ObjectSet], extent: tuple[float, float, float]
) -> dict[str, list[str]]:
    """Return the models whose centre is not in the volume around the mean of all cameras, by scan."""
    half = torch.tensor(extent, dtype=torch.float64) / 2
    outside = {}
    for scan, found in objects.items():
        offset = found.center.double() - torch.tensor(facts[scan]["camera_center"], dtype=torch.float64)
        outside[scan] = _names(found.model_id, (offset.abs() > half).any(dim=1))
    return {scan: names for scan, names in outside.items() if names}


def _where(
    annotated: Mapping[str, SceneAnnotation], test: Callable[[SceneAnnotation], Tensor]
) -> dict[str, list[str]]:
    """Return the models that pass a test, by scan."""
    passed = {scan: _names(found.model_id, test(found)) for scan, found in annotated.items()}
    return {scan: names for scan, names in passed.items() if names}


def _is_mirrored(found: SceneAnnotation) -> Tensor:
    return torch.linalg.det(found.scan_from_cad[:, :3, :3]) < 0


def _is_flat(found: SceneAnnotation) -> Tensor:
    return (found.box_half_size <= 0).any(dim=1)


def _names(model_ids: Sequence[str], chosen: Tensor) -> list[str]:
    return [name for name, is_chosen in zip(model_ids, chosen.tolist(), strict=True) if is_chosen]
