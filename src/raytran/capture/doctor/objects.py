# SPDX-License-Identifier: Apache-2.0
"""The annotation: size and stance of its boxes, their place in the scan, and the CADs that it names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from raytran.capture.doctor.depth import SurfacePoints
from raytran.capture.doctor.finding import Finding
from raytran.data.scan2cad import SceneAnnotation
from raytran.data.shapenet.models import STEM, is_boxed, model_folder, read_binvox, read_mesh
from raytran.errors import DataError
from raytran.geometry.boxes import OrientedBoxes
from raytran.geometry.boxes_in_view import boxes_in_view
from raytran.geometry.camera import Cameras
from raytran.structs import ObjectSet

MISPLACED = "annotation not where the images show objects"
"""Cause where no reading puts the boxes right."""

_SMALL, _LARGE = 0.08, 8.0
"""Metres between which the median diagonal of a room's objects must lie."""

_LYING_DEG = 35.0
"""Median tilt above which the annotation's axes are wrong; real ones reach five degrees."""

_UNITS = {"centimetres": 0.01, "millimetres": 0.001, "decametres or another large unit": 100.0}

_SLACK = 0.05
"""Metres by which a point may lie before or behind a box and still count as on it."""

_MIN_POINTS = 25
"""Points in boxes below which the best reading is not believed."""

_POOR, _CLEARLY_BETTER, _MORE_INSIDE = 0.15, 0.12, 1.3
_MISSING_WEIGHT = 0.05
"""Weight of rays that meet no box: a reading that moves all boxes out of sight must not win."""

_BOX_DIFFERS = 2e-4
"""Difference of boxes, CAD units, above which they are not of the same mesh; right ones agree to 1e-6."""

_VOXELS_DIFFER = 0.1
"""Share of the surface by which another reading must hit more voxels."""

_QUARTER = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
_MESH_CHANGES: tuple[tuple[str, NDArray[np.float64]], ...] = (
    ("mirrored in x", np.diag([-1.0, 1.0, 1.0])),
    ("mirrored in z", np.diag([1.0, 1.0, -1.0])),
    ("mirrored in y", np.diag([1.0, -1.0, 1.0])),
    ("turned by 90° about y, as in ShapeNetCore v1", _QUARTER),
    ("turned by -90° about y, as in ShapeNetCore v1", _QUARTER.T),
    ("turned by 180° about y", np.diag([-1.0, 1.0, -1.0])),
)
_SAMPLES = 4000


def check_boxes(objects: ObjectSet) -> tuple[ObjectSet, list[Finding]]:
    """Check that boxes have the size and stance of furniture.

    Args:
        objects: M of them, at least one.

    Returns:
        The objects in metres, and the findings.
    """
    median = float(objects.size.double().norm(dim=1).median())
    text = f"the median diagonal of {len(objects)} boxes is {median:.3g}"
    if _SMALL < median < _LARGE:
        size = Finding("annotation unit", "ok", f"{text} m")
    else:
        name, scale = min(_UNITS.items(), key=lambda unit: abs(np.log(median * unit[1])))
        fix = f"multiply the annotation's translations and scales by {scale:g}"
        size = Finding("annotation unit", "fault", text, f"annotation in {name}", fix, "certain")
        objects = replace(objects, center=objects.center * scale, size=objects.size * scale)
    # Angle between the boxes' up (third column) and +z.
    tilt = torch.rad2deg(torch.acos(objects.rotation[:, 2, 1].double().clamp(-1, 1)))
    text = f"boxes lean by {float(tilt.median()):.1f}° in the median, at most by {float(tilt.max()):.1f}°"
    if float(tilt.median()) < _LYING_DEG:
        return objects, [size, Finding("objects upright", "ok", text)]
    fix = "it must map CADs with +y up into a world with +z up: see whether a turn is missing or doubled"
    return objects, [size, Finding("objects upright", "fault", text, "objects lie down", fix, "certain")]


def rotated(objects: ObjectSet, rotation: NDArray[np.float64]) -> ObjectSet:
    """Return objects in a world rotated by ``(3, 3)``."""
    matrix = torch.from_numpy(rotation).to(objects.center)
    return replace(objects, center=objects.center @ matrix.T, rotation=matrix @ objects.rotation)


@dataclass(frozen=True)
class WorldReading:
    """A way to read the files: which world the cameras or the annotation are in.

    Attributes:
        right_from_given: ``(4, 4)`` what must be applied to the cameras so that they share the boxes' world.
        cause: short name of the fault.
        fix: one sentence.
    """

    right_from_given: NDArray
    cause: str
    fix: str


@dataclass(frozen=True)
class BoxHits:
    """How the rays to visible surfaces meet the boxes under one reading.

    Attributes:
        score: share of the rays meeting a box that end in it, weighed down where few meet any.
        inside: rays that end in a box.
        through: rays that pass through a box.
    """

    score: float
    inside: int
    through: int


def alignment_readings(axis_alignment: NDArray[np.float64]) -> list[WorldReading]:
    """Return what may have happened to one side only with ``axisAlignment``, aligned_from_scan."""
    if np.allclose(axis_alignment, np.eye(4), atol=1e-4):
        return []
    inverse = np.linalg.inv(axis_alignment)
    once = "applied to one side only"
    return [
        WorldReading(
            inverse,
            f"axisAlignment {once} (the cameras)",
            "apply it to neither: multiply each camera-to-world matrix from the left by its inverse",
        ),
        WorldReading(
            axis_alignment,
            f"axisAlignment {once} (the annotation)",
            "apply it to neither: multiply the annotation's scan transforms from the right by the inverse of "
            "what they were given",
        ),
        WorldReading(
            inverse @ inverse,
            "axisAlignment applied twice (to the cameras)",
            "multiply each camera-to-world matrix twice from the left by the inverse of axisAlignment",
        ),
        WorldReading(
            axis_alignment @ axis_alignment,
            "axisAlignment applied twice (to the annotation, or its inverse to the cameras)",
            "use poses and annotation as they were released, without axisAlignment",
        ),
    ]


def rotation_readings() -> list[WorldReading]:
    """Return the quarter turns about z by which worlds of other programs differ."""
    quarter = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64)
    named = (("90°", quarter), ("180°", quarter @ quarter), ("-90°", quarter.T))
    return [
        WorldReading(
            rotation,
            f"cameras and annotation are turned by {angle} about +z to each other",
            f"multiply each camera-to-world matrix from the left by {rotation[:3, :3].astype(int).tolist()}",
        )
        for angle, rotation in named
    ]


def count_hits(
    surface: SurfacePoints,
    world_from_camera: NDArray[np.float64],
    objects: ObjectSet,
    transform: NDArray[np.float64],
) -> BoxHits:
    """Count the rays that end in boxes and those that pass through them (slab test in each box's axes).

    Args:
        surface: n points, each at the end of a ray.
        world_from_camera: ``(frames, 4, 4)``.
        objects: M boxes.
        transform: ``(4, 4)`` applied to the cameras first.
    """
    origin, direction = surface.rays_in_world(transform @ world_from_camera)
    inside = through = 0
    misses = np.ones(len(surface), dtype=bool)
    centers, sizes, rotations = (
        tensor.double().numpy() for tensor in (objects.center, objects.size, objects.rotation)
    )
    for center, size, rotation in zip(centers, sizes, rotations, strict=True):
        start, slope = (origin - center) @ rotation, direction @ rotation
        slope = np.where(np.abs(slope) < 1e-9, 1e-9, slope)
        # Where each ray crosses the two planes of each axis, in units of depth.
        low, high = (-size / 2 - start) / slope, (size / 2 - start) / slope
        enters, leaves = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
        meets = (enters < leaves) & (leaves > 0)
        ends = meets & (surface.depth > enters - _SLACK) & (surface.depth < leaves + _SLACK)
        passes = meets & (surface.depth >= leaves + _SLACK)
        inside += int(ends.sum())
        through += int(passes.sum())
        misses &= ~(ends | passes)
    total = inside + through + _MISSING_WEIGHT * int(misses.sum())
    return BoxHits(inside / max(total, 1e-9), inside, through)


def check_placement(
    surface: SurfacePoints,
    world_from_camera: NDArray[np.float64],
    objects: ObjectSet,
    axis_alignment: NDArray[np.float64],
) -> tuple[NDArray[np.float64], Finding]:
    """Check that the boxes are where the images show something.

    Args:
        surface: n points that the images show.
        world_from_camera: ``(frames, 4, 4)``.
        objects: M boxes.
        axis_alignment: ``(4, 4)`` aligned_from_scan.

    Returns:
        ``(4, 4)`` what to apply to the cameras, and the finding.
    """
    check = "annotation placed"
    given = count_hits(surface, world_from_camera, objects, np.eye(4))
    readings = alignment_readings(axis_alignment) + rotation_readings()
    hits = [count_hits(surface, world_from_camera, objects, reading.right_from_given) for reading in readings]
    # A reading that moves boxes to where little is seen may score higher; it must catch more rays, too.
    rivals = [i for i, after in enumerate(hits) if after.inside > _MORE_INSIDE * given.inside]
    best = max(rivals, key=lambda i: hits[i].score, default=None)
    text = f"{given.inside} rays end in the boxes and {given.through} pass through ({surface.source})"
    if (
        best is not None
        and hits[best].score > given.score + _CLEARLY_BETTER
        and hits[best].inside >= _MIN_POINTS
    ):
        reading, after = readings[best], hits[best]
        text = f"{text}; after the change {after.inside} and {after.through}"
        is_certain = after.score > 3 * given.score and after.inside > 4 * _MIN_POINTS
        confidence = "certain" if is_certain else "likely"
        return reading.right_from_given, Finding(check, "fault", text, reading.cause, reading.fix, confidence)
    meet = given.inside + given.through
    if meet < _MIN_POINTS and len(surface) < 40 * _MIN_POINTS:
        return np.eye(4), Finding(check, "unknown", f"{text}: too few to tell")
    if meet < _MIN_POINTS or given.inside < _POOR * meet:
        fix = "check that annotation and poses are of the same scan and world"
        return np.eye(4), Finding(check, "fault", text, MISPLACED, fix, "likely")
    return np.eye(4), Finding(check, "ok", text)


def check_in_view(objects: ObjectSet, cameras: Cameras) -> Finding:
    """Check that cameras look at the boxes; in another world than theirs, boxes lie anywhere.

    Args:
        objects: M boxes, at least one.
        cameras: of the N frames.
    """
    boxes = OrientedBoxes(*(t.double() for t in (objects.center, objects.size, objects.rotation)))
    unseen = int((~boxes_in_view(boxes, cameras)).sum())
    text = f"{unseen} of {len(objects)} boxes lie where no camera looks"
    if unseen > len(objects) / 2:
        fix = "annotate in the world of the poses, in metres, or take the poses that belong to the annotation"
        return Finding(
            "boxes in view", "fault", text, "boxes in another world than the poses", fix, "certain"
        )
    return Finding("boxes in view", "note" if unseen else "ok", text)


@dataclass(frozen=True)
class _Mismatch:
    """A CAD that is not the one that was annotated.

    Attributes:
        model: its name.
        cause: what happened to it.
        shown_by: what shows that.
    """

    model: str
    cause: str
    shown_by: str


def check_models(annotation: SceneAnnotation, shapenet_root: Path | None) -> list[Finding]:
    """Check that no CAD or its alignment is mirrored, turned, missing or another one.

    Args:
        annotation: of one scan, K CADs.
        shapenet_root: folder of the categories, or None if the CADs are not there.
    """
    findings = [_check_handedness(annotation)]
    if shapenet_root is None:
        return [*findings, Finding("CAD meshes", "unknown", "no folder of CAD models was found")]
    boxes = {
        model: (center, half)
        for model, center, half in zip(
            annotation.model_id, annotation.box_center.numpy(), annotation.box_half_size.numpy(), strict=True
        )
    }
    mismatches: list[_Mismatch] = []
    missing: list[str] = []
    for model, (center, half) in boxes.items():
        try:
            mismatch = _mismatch(model, center, half, shapenet_root)
        except DataError as error:
            missing.append(str(error))
            continue
        if mismatch is not None:
            mismatches.append(mismatch)
    if missing:
        first = missing[0].partition(";")[0]
        text = f"{len(missing)} of {len(boxes)} CADs cannot be read, the first: {first}"
        fix = "copy them from ShapeNetCore.v2 again; prepare leaves objects without a CAD out"
        findings.append(Finding("CAD files", "fault", text, "missing CADs", fix, "certain"))
    return [*findings, _summary(mismatches, len(boxes) - len(missing))]


def _check_handedness(annotation: SceneAnnotation) -> Finding:
    mirrored = np.linalg.det(annotation.scan_from_cad[:, :3, :3].numpy()) < 0
    count = int(mirrored.sum())
    if not count:
        return Finding("handedness", "ok", f"none of {len(mirrored)} alignments mirrors its CAD")
    names = [name for name, is_mirrored in zip(annotation.model_id, mirrored, strict=True) if is_mirrored]
    return Finding(
        "handedness",
        "fault",
        f"{count} of {len(mirrored)} alignments have a negative determinant, the first is {names[0]}",
        "mirrored CADs (negative scale)",
        "make scale positive: flip the mesh instead, or leave these objects out",
        "certain",
    )


def _summary(mismatches: list[_Mismatch], count: int) -> Finding:
    """Return the finding on the meshes of ``count`` readable CADs."""
    if not mismatches:
        return Finding("CAD meshes", "ok", f"the boxes and voxels of {count} CADs are those of their meshes")
    first = mismatches[0]
    causes = sorted({mismatch.cause for mismatch in mismatches})
    if any(cause.startswith("mirrored") for cause in causes):
        name = "mirrored CADs"
    else:
        name = "turned CADs" if "turned" in first.cause else "other CADs"
    text = (
        f"{len(mismatches)} of {count} CADs, the first is {first.model}, by {first.shown_by}: "
        f"{'; '.join(causes)}"
    )
    fix = "restore model_normalized.obj from ShapeNetCore.v2, or undo the change for vertices and normals"
    confidence = "certain" if "and" in first.shown_by else "likely"
    return Finding("CAD meshes", "fault", text, name, fix, confidence)


def _mismatch(model: str, center: NDArray, half: NDArray, root: Path) -> _Mismatch | None:
    """Compare a mesh with the annotation's box (``center``, ``half`` size) and with its own voxels."""
    mesh = read_mesh(root, *model.split("/"))
    used = mesh.vertices[np.unique(mesh.faces)]
    if is_boxed(root, *model.split("/")):
        # It shows what a scan has seen of an object, which may be a part of the box, but nothing else.
        beyond = float((np.abs(used - center) - half).max())
        is_right = beyond <= _BOX_DIFFERS
        return None if is_right else _Mismatch(model, f"mesh leaves its box by {beyond:.3f}", "the box")

    def box_error(change: NDArray) -> float:
        points = used @ change.T
        low, high = points.min(axis=0), points.max(axis=0)
        return float(max(np.abs((low + high) / 2 - center).max(), np.abs((high - low) / 2 - half).max()))

    hits = _voxel_hits(mesh, model_folder(root, *model.split("/")))
    error = box_error(np.eye(3))
    by_box = [
        name for name, change in _MESH_CHANGES if error > _BOX_DIFFERS and box_error(change) < 0.2 * error
    ]
    by_voxels = [
        name for name, change in _MESH_CHANGES if hits and hits(change) > hits(np.eye(3)) + _VOXELS_DIFFER
    ]
    if by_box:
        both = [name for name in by_box if name in by_voxels]
        shown_by = "the annotation's box and its voxels" if both else "the annotation's box"
        return _Mismatch(model, (both or by_box)[0], shown_by)
    if by_voxels and hits:
        best = max(by_voxels, key=lambda name: round(hits(dict(_MESH_CHANGES)[name]), 2))
        return _Mismatch(model, best, "its voxels")
    if error > 0.01:
        return _Mismatch(model, f"box differs by {error:.3f} from the annotation's", "the annotation's box")
    return None


def _voxel_hits(mesh: trimesh.Trimesh, folder: Path) -> Callable[[NDArray], float] | None:
    """Return a function: share of the surface, changed by ``(3, 3)``, in voxels of the model's binvox."""
    paths = (folder / f"{STEM}.{kind}.binvox" for kind in ("surface", "solid"))
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return None
    try:
        cells, translate, scale = read_binvox(path)
    except DataError:
        return None
    points, _ = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)

    def hits(change: NDArray) -> float:
        index = np.floor((points @ change.T - translate) / scale * len(cells)).astype(int)
        # Surfaces lie on the border of cells: one cell to either side counts.
        return float(np.mean(np.any([_filled(cells, index + step) for step in (-1, 0, 1)], axis=0)))

    return hits


def _filled(cells: NDArray[np.bool_], index: NDArray) -> NDArray[np.bool_]:
    """Return whether the cells at ``(n, 3)`` indices are filled; those outside of the grid are not."""
    is_inside = ((index >= 0) & (index < len(cells))).all(axis=1)
    return is_inside & cells[tuple(index.clip(0, len(cells) - 1).T)]
