# SPDX-License-Identifier: Apache-2.0
"""Describes generated rooms in files beside them: ``report.json``, ``report.txt``, ``rooms.jpg``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import trimesh
from PIL import Image

from raytran.classes import PAPER_CLASSES
from raytran.data.files import whole_file, write_json, write_text
from raytran.data.prepare.report import class_table
from raytran.data.scan2cad import SceneAnnotation, read_annotations, scene_objects
from raytran.data.scannet.scan import read_scan
from raytran.data.targets import cad_meshes
from raytran.pictures.overlay import draw_objects
from raytran.pictures.panels import contact_sheet
from raytran.rooms.statistics import listed_scans, look, rooms_statistics, scan_cameras

_ROOMS_SHOWN = 5
"""Rooms of each split on the sheet: a row of frames and a row of the same with their objects drawn in."""

_SHEET_WIDTH = 800


def report_on_rooms(root: Path) -> str:
    """Write the three files into a data set of rooms and return the text.

    Raises:
        DataError: a part of the data set is missing or damaged.
    """
    statistics = rooms_statistics(root)
    text = rooms_text(statistics)
    write_json(root / "report.json", statistics)
    write_text(root / "report.txt", text)
    draw_rooms(root / "rooms.jpg", root)
    return text


def rooms_text(statistics: Mapping[str, Mapping[str, Any]]) -> str:
    """Return ``rooms_statistics`` as a text with a column for each split."""
    lines = [" " * 35 + "".join(f"{name:>18}" for name in statistics)]
    for what, cells in _rows(list(statistics.values())):
        lines.append(f"{what:<35}" + "".join(f"{cell:>18}" for cell in cells))
    by_class = {name: of_split["by_class"] for name, of_split in statistics.items()}
    counts = {
        split: {name: of[name]["objects"] for name in PAPER_CLASSES.names} for split, of in by_class.items()
    }
    sizes = [
        f"         {name:<11}" + "".join(f"{_size(of[name]['size_m']):>22}" for of in by_class.values())
        for name in PAPER_CLASSES.names
    ]
    header = "Median width × height × depth, m" + "  " + ", ".join(by_class)
    return "\n".join([*lines, "", *class_table(counts), "", header, *sizes]) + "\n"


def draw_rooms(path: Path, root: Path) -> Path:
    """Write a sheet of some rooms of each split: the frame that shows most objects, plain and drawn over.

    Raises:
        DataError: a part of the data set is missing or damaged.
    """
    annotations = read_annotations(root / "scan2cad" / "full_annotations.json")
    tiles: list[Image.Image] = []
    for scans in listed_scans(root).values():
        pairs = [_pictures(root, annotations[scan]) for scan in scans[:_ROOMS_SHOWN]]
        for row in zip(*pairs, strict=True):
            blank = Image.new("RGB", row[0].size, "white")
            tiles += [*row, *([blank] * (_ROOMS_SHOWN - len(row)))]
    with whole_file(path) as temporary:
        contact_sheet(temporary, tiles, _ROOMS_SHOWN, width=_SHEET_WIDTH)
    return path


def _pictures(root: Path, annotation: SceneAnnotation) -> tuple[Image.Image, Image.Image]:
    objects, cameras = scene_objects(annotation), scan_cameras(root, annotation.scene_id)
    shapenet = root / "shapenet"
    best = int(look(objects, cameras, shapenet_root=shapenet).shown.sum(dim=0).argmax())
    with read_scan(root / "scannet" / "scans" / annotation.scene_id) as scan:
        frame = Image.fromarray(scan.read_color(best))
    camera = cameras[best]
    meshes = [trimesh.Trimesh(*mesh, process=False) for mesh in cad_meshes(objects, shapenet_root=shapenet)]
    return frame, draw_objects(frame, camera, objects, meshes)


def _rows(splits: list[Mapping[str, Any]]) -> Iterator[tuple[str, list[str]]]:
    """Yield the rows of the table: what a row is of, and its text for each split."""
    sights = [split["sight"] for split in splits]
    per_room = [split["objects_per_room"] for split in splits]
    yield "rooms", [str(split["rooms"]) for split in splits]
    yield "frames a room", [", ".join(map(str, split["frames_per_room"])) for split in splits]
    yield "objects", [str(split["objects"]) for split in splits]
    yield "CAD models", [str(split["cad_models"]) for split in splits]
    yield "objects a room, mean (range)", [f"{q['mean']} ({q['min']:g} to {q['max']:g})" for q in per_room]
    yield "  of half of the rooms", [f"{q['quarter']:g} to {q['three_quarters']:g}" for q in per_room]
    yield "rooms of at most 10 objects", [str(split["rooms_with_at_most"]["10"]) for split in splits]
    yield "rooms whose frames were looked at", [str(sight["rooms"]) for sight in sights]
    frames = [sight["frames_per_object"] for sight in sights]
    yield "frames that show an object, median", [f"{q['median']:g}" for q in frames]
    yield "  of half of the objects", [f"{q['quarter']:g} to {q['three_quarters']:g}" for q in frames]
    yield "objects a frame shows, mean", [str(sight["objects_per_frame"]) for sight in sights]
    yield "not hidden of an outline, mean", [f"{sight['visible_share']:.1%}" for sight in sights]
    yield "outlines mostly hidden", [f"{sight['mostly_hidden']:.1%}" for sight in sights]


def _size(size: list[float] | None) -> str:
    return "none" if size is None else " × ".join(f"{side:.2f}" for side in size)
