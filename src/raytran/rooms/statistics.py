# SPDX-License-Identifier: Apache-2.0
"""What a set of rooms is like, in numbers: objects, classes, sizes, and how much of them is seen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from raytran.classes import PAPER_CLASSES
from raytran.data.scan2cad import SceneAnnotation, read_annotations, scene_objects
from raytran.data.scannet.scan import read_scan
from raytran.data.scene_list import read_split
from raytran.data.targets import cad_meshes
from raytran.data.views import choose_even
from raytran.geometry.camera import Cameras
from raytran.geometry.rasterize import rasterize_ids, rasterize_mask
from raytran.structs import ObjectSet

SPLITS = ("train", "val", "test")

MAX_EXAMINED = 40
"""Scans of a split, spread evenly, in which the visible pixels of objects are counted."""

MIN_VISIBLE_SHARE = 0.5
"""Share of an object's outline in a frame that must not be hidden for the frame to show the object."""

_ROWS = 48
"""Rows of the pictures in which pixels are counted."""

_MIN_PIXELS = 4


@dataclass(frozen=True)
class Sight:
    """How the ``M`` objects of a scan show in its ``N`` frames.

    Attributes:
        outline: ``(M, N)`` int64 pixels of the object's outline, hidden or not.
        visible: ``(M, N)`` int64 those that no other object hides.
    """

    outline: Tensor
    visible: Tensor

    @property
    def shown(self) -> Tensor:
        """``(M, N)`` bool: a frame shows the object, not a corner of it and not mostly hidden."""
        return (self.outline >= _MIN_PIXELS) & (self.visible >= MIN_VISIBLE_SHARE * self.outline)


def rooms_statistics(root: Path) -> dict[str, dict[str, Any]]:
    """Describe each split of a data set laid out as ``root/{scannet,scan2cad,shapenet}``.

    Returns:
        by split that is not empty: numbers of ``rooms``, ``objects`` and ``cad_models``, ``frames_per_room``,
        ``objects_per_room`` (quantiles), ``by_class`` (``objects`` and the median ``size_m`` as width, height
        and depth), and ``sight``, see ``_describe_sight``.

    Raises:
        DataError: a file is missing or damaged.
    """
    annotations = read_annotations(root / "scan2cad" / "full_annotations.json")
    return {name: _describe(root, scans, annotations) for name, scans in listed_scans(root).items()}


def listed_scans(root: Path) -> dict[str, list[str]]:
    """Return the scans of each split that has any."""
    present = [name for name in SPLITS if (root / "scannet" / f"scannetv2_{name}.txt").is_file()]
    listed = {name: read_split(root / "scannet", name) for name in present}
    return {name: scans for name, scans in listed.items() if scans}


def look(objects: ObjectSet, cameras: Cameras, *, shapenet_root: Path) -> Sight:
    """Count the pixels of each object in each frame; pixels that only a wall hides count as visible.

    Args:
        objects: ``M`` objects with model names.
        cameras: of ``N`` frames.
        shapenet_root: folder of the categories.

    Raises:
        DataError: a CAD file is missing or cannot be read.
    """
    height, width = cameras.image_size
    small = cameras.scaled_to((_ROWS, round(_ROWS * width / height)))
    meshes = cad_meshes(objects, shapenet_root=shapenet_root)
    nearest, _ = rasterize_ids(meshes, small)
    outline = [rasterize_mask([mesh], small).sum(dim=(1, 2)) for mesh in meshes]
    visible = [(nearest == m).sum(dim=(1, 2)) for m in range(len(meshes))]
    return Sight(torch.stack(outline), torch.stack(visible))


def scan_cameras(root: Path, scan_id: str) -> Cameras:
    """Return the cameras of all usable frames of a scan, leading dimensions ``(N,)``.

    Raises:
        DataError: the scan is missing or damaged.
    """
    return read_scan(root / "scannet" / "scans" / scan_id).cameras.to(torch.float32)


def _describe(root: Path, scans: Sequence[str], annotations: dict[str, SceneAnnotation]) -> dict[str, Any]:
    objects_of = {scan: scene_objects(annotations[scan]) for scan in scans}
    counts = torch.tensor([len(objects) for objects in objects_of.values()], dtype=torch.float64)
    examined = [scans[i] for i in choose_even(len(scans), min(len(scans), MAX_EXAMINED)).tolist()]
    sights = [
        look(objects_of[scan], scan_cameras(root, scan), shapenet_root=root / "shapenet") for scan in examined
    ]
    names = [name for objects in objects_of.values() for name in objects.model_id]
    return {
        "rooms": len(scans),
        "objects": len(names),
        "cad_models": len(set(names)),
        "frames_per_room": dict(sorted(Counter(sight.outline.shape[1] for sight in sights).items())),
        "objects_per_room": {"mean": round(float(counts.mean()), 2)} | _quantiles(counts),
        "rooms_with_at_most": {str(most): int((counts <= most).sum()) for most in (10, 20, 30)},
        "by_class": _by_class(list(objects_of.values())),
        "sight": _describe_sight(sights),
    }


def _by_class(scenes: Sequence[ObjectSet]) -> dict[str, dict[str, Any]]:
    label = torch.cat([objects.label for objects in scenes])
    size = torch.cat([objects.size for objects in scenes])
    return {
        name: {"objects": int((label == index).sum()), "size_m": _median(size[label == index])}
        for index, name in enumerate(PAPER_CLASSES.names)
    }


def _median(size: Tensor) -> list[float] | None:
    return [round(side, 2) for side in size.median(dim=0).values.tolist()] if len(size) else None


def _describe_sight(sights: Sequence[Sight]) -> dict[str, Any]:
    """Return what frames show of the objects.

    Returns:
        number of ``rooms`` examined; ``frames_per_object``, frames that show an object (quantiles over the
        objects); ``objects_per_frame``, objects that a frame shows (mean); ``visible_share`` of an object's
        outline where any of it is in the picture (mean); and ``mostly_hidden``, the share of such outlines
        that are visible by less than ``MIN_VISIBLE_SHARE``.
    """
    shares = []
    for sight in sights:
        in_picture = sight.outline >= _MIN_PIXELS
        shares.append(sight.visible[in_picture] / sight.outline[in_picture])
    share = torch.cat(shares)
    frames = torch.cat([sight.shown.sum(dim=1) for sight in sights]).double()
    objects = torch.cat([sight.shown.sum(dim=0) for sight in sights]).double()
    return {
        "rooms": len(sights),
        "frames_per_object": _quantiles(frames),
        "objects_per_frame": round(float(objects.mean()), 2),
        "visible_share": round(float(share.mean()), 3),
        "mostly_hidden": round(float((share < MIN_VISIBLE_SHARE).double().mean()), 3),
    }


def _quantiles(values: Tensor) -> dict[str, float]:
    points = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0], dtype=torch.float64)
    names = ("min", "quarter", "median", "three_quarters", "max")
    return {name: float(value) for name, value in zip(names, torch.quantile(values, points), strict=True)}
