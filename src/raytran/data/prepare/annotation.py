# SPDX-License-Identifier: Apache-2.0
"""Reads the usable entries of an annotation file; the others are left out, with the reason."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from raytran.data.scan2cad import SMALLEST_SCALE, parse_entry, read_entries
from raytran.errors import DataError
from raytran.limits import shown

ANNOTATIONS = "full_annotations.json"
NO_CAD = "no CAD file"
DEGENERATE = "scale or box of size zero"

Entry = dict[str, Any]
"""One scan's part of ``full_annotations.json``."""

_MAX_SHOWN = 100
"""Characters of a wrong name that the report shows."""

_PLAIN_NAME = re.compile(r"[\w-]+")
"""Names become names of folders: nothing that leads elsewhere."""


@dataclass(frozen=True)
class LeftOut:
    """A model, or a whole entry, of an annotation that cannot be used.

    Attributes:
        scan: name of the scan.
        model: ``catid/id``; empty for the whole entry.
        reason: why it cannot be used.
    """

    scan: str
    model: str
    reason: str


@dataclass(frozen=True)
class Annotations:
    """The content of an annotation file.

    Attributes:
        entries: by scan, if it has usable models; models that cannot be used are removed.
        empty: scans whose entry lists no models.
        left_out: entries and models that cannot be used.
        twice: scans with several entries, of which the first is used.
    """

    entries: dict[str, Entry] = field(default_factory=dict)
    empty: list[str] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    twice: list[str] = field(default_factory=list)


def find_annotations(path: Path) -> Path:
    """Return the annotation file: ``path`` itself, or the one in that folder or up to two folders below.

    Raises:
        DataError: there is none, or several.
    """
    if path.is_file():
        return path
    files = [file for depth in ("", "*/", "*/*/") for file in sorted(path.glob(f"{depth}{ANNOTATIONS}"))]
    if len(files) != 1:
        state = "several files" if files else "no file"
        raise DataError(f"there is {state} {ANNOTATIONS} in {path}: give the path of the one to use")
    return files[0]


def read_usable(path: Path) -> Annotations:
    """Read an annotation file; entries and models that are damaged are left out and named.

    Raises:
        DataError: the file is missing or no list of scenes.
    """
    annotations = Annotations()
    seen: set[str] = set()
    for number, entry in enumerate(read_entries(path)):
        try:
            scene_id, models = _scene_and_models(entry)
        except DataError as error:
            name = entry.get("id_scan") if isinstance(entry, dict) else None
            known = name if isinstance(name, str) and name.isprintable() else ""
            annotations.left_out.append(LeftOut(known[:_MAX_SHOWN] or f"entry {number}", "", str(error)))
            continue
        if scene_id in seen:
            annotations.twice.append(scene_id)
            continue
        seen.add(scene_id)
        reasons = _reasons(entry, models)
        annotations.left_out.extend(
            LeftOut(scene_id, _name_or_nothing(model), reason)
            for model, reason in zip(models, reasons, strict=True)
            if reason
        )
        if not models:
            annotations.empty.append(scene_id)
        elif not all(reasons):
            annotations.entries[scene_id] = _with_models(
                entry, [model for model, reason in zip(models, reasons, strict=True) if not reason]
            )
    return annotations


def _scene_and_models(entry: Any) -> tuple[str, list[Any]]:
    """Return the name of an entry's scan, and its models unchecked.

    Raises:
        DataError: the entry is damaged apart from its models.
    """
    if not isinstance(entry, dict) or not isinstance(entry.get("aligned_models"), list):
        raise DataError("it is no object with a list of aligned_models")
    scene_id = parse_entry(entry | {"aligned_models": []}).scene_id
    _check_name(scene_id)
    return scene_id, entry["aligned_models"]


def model_name(model: Mapping[str, Any]) -> str:
    """Return ``catid/id`` of an entry of ``aligned_models``."""
    return f"{model['catid_cad']}/{model['id_cad']}"


def used_models(entries: Iterable[Entry]) -> list[str]:
    """Return ``catid/id`` of every model that occurs, sorted."""
    return sorted({model_name(model) for entry in entries for model in entry["aligned_models"]})


def without_models(entry: Entry, broken: Mapping[str, str]) -> tuple[Entry, list[LeftOut]]:
    """Return the entry of a scan without the models whose CAD file cannot be used, and these models.

    Args:
        entry: of a scan.
        broken: why a CAD file cannot be used, by ``catid/id``.
    """
    names = [(model, model_name(model)) for model in entry["aligned_models"]]
    left_out = [LeftOut(entry["id_scan"], name, broken[name]) for _, name in names if name in broken]
    return _with_models(entry, [model for model, name in names if name not in broken]), left_out


def _reasons(entry: Entry, models: list[Any]) -> list[str]:
    """Return why each model cannot be used, empty if it can."""
    # One damaged model fails them all, so then each is looked at by itself.
    try:
        return _reasons_together(entry, models)
    except (DataError, TypeError, KeyError):
        pass
    reasons = []
    for model in models:
        try:
            reasons += _reasons_together(entry, [model])
        except DataError as error:
            reasons.append(str(error))
        except (TypeError, KeyError):
            reasons.append("it is no object with catid_cad and id_cad")
    return reasons


def _reasons_together(entry: Entry, models: list[Any]) -> list[str]:
    for model in models:
        _check_name(model["catid_cad"])
        _check_name(model["id_cad"])
    scene = parse_entry(_with_models(entry, models))
    scale = scene.scan_from_cad[:, :3, :3].norm(dim=1)
    # A flat sheet is an object; a line or a point is none.
    no_size = (scale < SMALLEST_SCALE).any(dim=1) | ((scene.box_half_size <= 0).sum(dim=1) > 1)
    return [DEGENERATE if bad else "" for bad in no_size.tolist()]


def _check_name(name: Any) -> None:
    if not isinstance(name, str) or not _PLAIN_NAME.fullmatch(name):
        raise DataError(f"the name {shown(name)} has other characters than letters, digits, _ and -")


def _name_or_nothing(model: Any) -> str:
    try:
        return model_name(model)[:_MAX_SHOWN]
    except (TypeError, KeyError):
        return ""


def _with_models(entry: Entry, models: list[Any]) -> Entry:
    return entry | {"n_aligned_models": len(models), "aligned_models": models}
