# SPDX-License-Identifier: Apache-2.0
"""Scans of ARKitScenes as released: frames with poses, a mesh, and oriented boxes of 17 classes.

A scan's folder holds ``<id>_frames/`` (which ``raytran.capture.arkit`` reads), ``<id>_3dod_annotation.json``
and ``<id>_3dod_mesh.ply``. All are in one world, +z up, in metres. A box is ``segments.obbAligned``: its
centroid, full lengths along its axes, and the axes, each a row of three numbers. The axes come in no order
that would tell the front of an object, so that each box is taken to look the same after half a turn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytran.capture.arkit import find_log
from raytran.capture.boxes.box_list import read_mesh_file
from raytran.capture.boxes.categories import Categories
from raytran.capture.open import open_scene
from raytran.capture.orientation import WorldSettings
from raytran.data.prepare.boxed_objects import BoxedObjects
from raytran.data.prepare.boxed_scan import FoundSources
from raytran.data.scan import OpenScan
from raytran.data.text import read_json_object
from raytran.errors import ConfigError, DataError
from raytran.limits import BOX_SIDE, POSITION, Quantity, as_numbers

SPLITS = {"Training": "train", "Validation": "val"}
"""Folders of the release → splits."""

_ROOTS = (".", "3dod", "raw", "ARKitScenes", "ARKitScenes/3dod", "ARKitScenes/raw")
"""Where the folders of splits may lie below the one that is given."""

_ANNOTATION, _MESH = "{}_3dod_annotation.json", "{}_3dod_mesh.ply"
_AXIS = Quantity("a part of an axis", -1.1, 1.1)
_RIGID = 0.02
"""Error of the axes' products up to which they are at right angles."""

_SQUARE = 0.2
"""Relative difference of width and depth up to which a box counts as the same after a quarter turn: the error
of a scale that Scan2CAD's benchmark allows. Hardly a picture tells which side of a chair is the longer."""

_HALF_TURN, _QUARTER_TURN = 2, 4


@dataclass(frozen=True)
class ArkitScan:
    """A scan of ARKitScenes; an ``AnnotatedSource``.

    Attributes:
        path: its folder.
        split: ``train`` or ``val``; None: the folder does not tell.
        categories: which classes there are.
    """

    path: Path
    split: str | None
    categories: Categories

    @property
    def scene_id(self) -> str:
        """Number of the scan."""
        return self.path.resolve().name

    @property
    def form(self) -> str:
        """What the report calls it."""
        return "arkitscenes"

    @property
    def annotation(self) -> Path:
        """File of its boxes."""
        return self.path / _ANNOTATION.format(self.scene_id)

    @property
    def state(self) -> str:
        """A digest of the annotation and of the classes."""
        return self.categories.state_of(self.annotation)

    def open(self) -> OpenScan:
        """Open its frames; images that are stored on their side are turned upright.

        Raises:
            DataError: they cannot be read.
        """
        # Axes, up and unit are those of the format: nothing is left to find out from images.
        return open_scene(self.path, format="arkit", settings=WorldSettings(check=False))

    def read_objects(self, scan: OpenScan) -> BoxedObjects:
        """Return its objects.

        Raises:
            DataError: the annotation is damaged or was skipped, or lists no box of a class.
        """
        content = read_json_object(self.annotation)
        if content.get("skipped"):
            raise DataError(f"{self.annotation} says that the scan was skipped: it has no boxes")
        boxes, others = _boxes_of_classes(content, self.annotation, self.categories)
        placed = [_placed(box, f"box {i} in {self.annotation}") for i, (box, _) in enumerate(boxes)]
        mesh = self.path / _MESH.format(self.scene_id)
        noticed = {"categories_left_out": others} if others else {}
        if not mesh.is_file():
            noticed["meshes_missing"] = [mesh.name]
        objects = BoxedObjects(
            named_in=str(self.annotation),
            category=tuple(name for _, name in boxes),
            center=np.array([center for center, _, _ in placed]),
            size=np.array([size for _, size, _ in placed]),
            rotation=np.array([rotation for _, _, rotation in placed]),
            symmetry=tuple(_symmetry(size) for _, size, _ in placed),
            mesh=(None,) * len(boxes),
            scan_mesh=read_mesh_file(mesh) if mesh.is_file() else None,
            noticed=noticed,
        )
        # The scan's world is kept: it is +z up by its format.
        return objects.moved(scan.world_from_input)


def find_arkitscenes(
    root: Path,
    categories: Categories,
    *,
    scenes: Sequence[str] | None = None,
    splits: Sequence[str] = ("train", "val"),
) -> FoundSources:
    """Find the scans below a folder of downloads.

    Args:
        root: folder with ``3dod/``, with ``Training/`` and ``Validation/``, one of these, or one scan.
        categories: which classes there are.
        scenes: names or patterns; None: all.
        splits: of train and val.

    Raises:
        ConfigError: there is no such split.
        DataError: there is no such folder, no scan with boxes in it, or none that a pattern means.
    """
    unknown = set(splits) - {*SPLITS.values(), "test"}
    if unknown:
        raise ConfigError(f"unknown splits {sorted(unknown)}: choose from {', '.join(SPLITS.values())}")
    if not root.is_dir():
        raise DataError(f"there is no folder {root}: check arkitscenes=")
    found = [(path, split) for path, split in _scan_folders(root) if split is None or split in splits]
    names = [path.name for path, _ in found]
    for pattern in scenes or ():
        if not any(fnmatchcase(name, pattern) for name in names):
            raise DataError(f"no scan in {root} is called {pattern}: check scenes= and splits=")
    if scenes is not None:
        found = [item for item in found if any(fnmatchcase(item[0].name, pattern) for pattern in scenes)]
    scans, without_boxes, without_frames = [], [], []
    for path, split in found:
        scan = ArkitScan(path, split, categories)
        has_boxes, has_frames = scan.annotation.is_file(), find_log(path) is not None
        if has_boxes and has_frames:
            scans.append(scan)
        elif has_boxes:
            without_frames.append(path.name)
        else:
            without_boxes.append(path.name)
    if not scans:
        raise _no_scan(root, without_boxes, without_frames)
    return FoundSources(tuple(scans), tuple(without_boxes), tuple(without_frames))


def _no_scan(root: Path, without_boxes: list[str], without_frames: list[str]) -> DataError:
    if without_frames:
        return DataError(
            f"scan {without_frames[0]} in {root} has an annotation and no frames: download "
            "<id>_frames with lowres_wide, lowres_wide_intrinsics and lowres_wide.traj"
        )
    if without_boxes:
        return DataError(
            f"none of the {len(without_boxes)} scans in {root} has boxes: download <id>_3dod_annotation.json"
        )
    return DataError(
        f"{root} holds no scans of ARKitScenes: give the folder with 3dod/Training and 3dod/Validation"
    )


def _scan_folders(root: Path) -> list[tuple[Path, str | None]]:
    """Return the folders of scans, with the split that each is in."""
    if (root / _ANNOTATION.format(root.resolve().name)).is_file() or find_log(root) is not None:
        return [(root.resolve(), SPLITS.get(root.resolve().parent.name))]
    if root.resolve().name in SPLITS:
        return [(path, SPLITS[root.resolve().name]) for path in _folders(root)]
    found: dict[str, tuple[Path, str | None]] = {}
    for place in _ROOTS:
        for folder, split in SPLITS.items():
            for path in _folders(root / place / folder):
                found.setdefault(path.name, (path, split))
    if not found:
        found = {path.name: (path, None) for path in _folders(root) if find_log(path) is not None}
    return [found[name] for name in sorted(found)]


def _folders(path: Path) -> list[Path]:
    return sorted(p for p in path.iterdir() if p.is_dir() and p.name[:1] != ".") if path.is_dir() else []


def _boxes_of_classes(
    content: Mapping[str, Any], path: Path, categories: Categories
) -> tuple[list[tuple[Mapping[str, Any], str]], list[str]]:
    """Return the boxes of some class with its name, and the other categories.

    Raises:
        DataError: there is no box of a class, or the file is damaged.
    """
    listed = content.get("data")
    if not isinstance(listed, list) or not all(isinstance(entry, dict) for entry in listed):
        raise DataError(f"{path} has no list of boxes, data: download it again")
    names = [categories.class_of(entry.get("label"), f"box {i} in {path}") for i, entry in enumerate(listed)]
    pairs = zip(listed, names, strict=True)
    boxes = [(_box(entry, path), name) for entry, name in pairs if name is not None]
    if not boxes:
        what = "no box of the classes that were asked for" if listed else "no box"
        raise DataError(f"{path} lists {what}: the scan is left out")
    others = {str(entry.get("label")) for entry, name in zip(listed, names, strict=True) if name is None}
    return boxes, sorted(others)


def _box(entry: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    segments = entry.get("segments")
    box = segments.get("obbAligned") if isinstance(segments, dict) else None
    if not isinstance(box, dict):
        raise DataError(f"{path} has an object without segments.obbAligned: download it again")
    return box


def _placed(
    box: Mapping[str, Any], where: str
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return centre ``(3,)``, size ``(3,)`` and rotation ``(3, 3)`` of a box in our object's frame.

    The axis that is nearest to the world's up becomes the object's; its width is the longer other side.

    Raises:
        DataError: the numbers make no box.
    """
    center = as_numbers(box.get("centroid"), (3,), POSITION, f"centroid of {where}")
    lengths = as_numbers(box.get("axesLengths"), (3,), BOX_SIDE, f"axesLengths of {where}")
    axes = as_numbers(box.get("normalizedAxes"), (3, 3), _AXIS, f"normalizedAxes of {where}")
    if np.abs(axes @ axes.T - np.eye(3)).max() > _RIGID:
        raise DataError(f"normalizedAxes of {where} are not at right angles: download the annotation again")
    left, _, right = np.linalg.svd(axes)
    axes = left @ right
    up = int(np.abs(axes[:, 2]).argmax())
    width, depth = sorted((i for i in range(3) if i != up), key=lambda i: -lengths[i])
    y = axes[up] * np.sign(axes[up, 2])
    x = axes[width]
    rotation = np.stack([x, y, np.cross(x, y)], axis=1)
    return center, lengths[[width, up, depth]], rotation


def _symmetry(size: NDArray[np.float64]) -> int:
    return _QUARTER_TURN if abs(size[0] - size[2]) <= _SQUARE * size[0] else _HALF_TURN
