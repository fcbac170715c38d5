# SPDX-License-Identifier: Apache-2.0
"""Mirrored or turned CADs: each mesh against the box in the annotation and the model's own voxels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from raytran.capture.doctor.finding import Finding
from raytran.data.scan2cad import SceneAnnotation
from raytran.data.shapenet.models import STEM, model_folder, read_binvox, read_mesh
from raytran.errors import DataError

_BOX_DIFFERS = 2e-4
"""Difference of boxes, CAD units, above which they are not of the same mesh; right ones agree to 1e-6."""

_VOXELS_DIFFER = 0.1
"""Share of the surface by which another reading must hit more voxels."""

_QUARTER = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
_TURNS: tuple[tuple[str, NDArray[np.float64]], ...] = (
    ("mirrored in x", np.diag([-1.0, 1.0, 1.0])),
    ("mirrored in z", np.diag([1.0, 1.0, -1.0])),
    ("mirrored in y", np.diag([1.0, -1.0, 1.0])),
    ("turned by 90° about y, as in ShapeNetCore v1", _QUARTER),
    ("turned by -90° about y, as in ShapeNetCore v1", _QUARTER.T),
    ("turned by 180° about y", np.diag([-1.0, 1.0, -1.0])),
)
_SAMPLES = 4000


@dataclass(frozen=True)
class _Doubt:
    model: str
    cause: str
    by: str


def check_models(annotation: SceneAnnotation, shapenet_root: Path | None) -> list[Finding]:
    """Say whether any CAD or its alignment is mirrored, turned, missing or another one.

    Args:
        annotation: of one scan.
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
    doubts: list[_Doubt] = []
    missing: list[str] = []
    for model, (center, half) in boxes.items():
        try:
            doubt = _doubt(model, center, half, shapenet_root)
        except DataError as error:
            missing.append(str(error))
            continue
        doubts += [doubt] if doubt else []
    if missing:
        first = missing[0].partition(";")[0]
        text = f"{len(missing)} of {len(boxes)} CADs cannot be read, the first: {first}"
        fix = "copy them from ShapeNetCore.v2 again; prepare leaves objects without a CAD out"
        findings.append(Finding("CAD files", "fault", text, "missing CADs", fix, "certain"))
    return [*findings, _summary(doubts, len(boxes) - len(missing))]


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


def _summary(doubts: list[_Doubt], count: int) -> Finding:
    if not doubts:
        return Finding("CAD meshes", "ok", f"the boxes and voxels of {count} CADs are those of their meshes")
    first = doubts[0]
    causes = sorted({doubt.cause for doubt in doubts})
    mirrored = any(cause.startswith("mirrored") for cause in causes)
    text = f"{len(doubts)} of {count} CADs, the first is {first.model}, by {first.by}: {'; '.join(causes)}"
    name = "mirrored CADs" if mirrored else "turned CADs" if "turned" in first.cause else "other CADs"
    fix = "restore model_normalized.obj from ShapeNetCore.v2, or undo the change for vertices and normals"
    return Finding("CAD meshes", "fault", text, name, fix, "certain" if "and" in first.by else "likely")


def _doubt(model: str, center: NDArray, half: NDArray, root: Path) -> _Doubt | None:
    mesh = read_mesh(root, *model.split("/"))
    used = mesh.vertices[np.unique(mesh.faces)]

    def box_error(turn: NDArray) -> float:
        points = used @ turn.T
        low, high = points.min(axis=0), points.max(axis=0)
        return float(max(np.abs((low + high) / 2 - center).max(), np.abs((high - low) / 2 - half).max()))

    hits = _voxel_hits(mesh, model_folder(root, *model.split("/")))
    given = box_error(np.eye(3))
    by_box = [name for name, turn in _TURNS if given > _BOX_DIFFERS and box_error(turn) < 0.2 * given]
    by_voxels = [name for name, turn in _TURNS if hits and hits(turn) > hits(np.eye(3)) + _VOXELS_DIFFER]
    if by_box:
        agreed = [name for name in by_box if name in by_voxels]
        by = "the annotation's box and its voxels" if agreed else "the annotation's box"
        return _Doubt(model, (agreed or by_box)[0], by)
    if by_voxels and hits:
        best = max(by_voxels, key=lambda name: round(hits(dict(_TURNS)[name]), 2))
        return _Doubt(model, best, "its voxels")
    if given > 0.01:
        return _Doubt(model, f"box differs by {given:.3f} from the annotation's", "the annotation's box")
    return None


def _voxel_hits(mesh: trimesh.Trimesh, folder: Path) -> Callable[[NDArray], float] | None:
    """Return a function: share of the surface, turned, that lies in voxels of the model's binvox file."""
    paths = (folder / f"{STEM}.{kind}.binvox" for kind in ("surface", "solid"))
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return None
    try:
        cells, translate, scale = read_binvox(path)
    except DataError:
        return None
    points, _ = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)

    def hits(turn: NDArray) -> float:
        index = np.floor((points @ turn.T - translate) / scale * len(cells)).astype(int)
        # Surfaces lie on the border of cells: one cell to either side counts.
        return float(np.mean(np.any([_lookup(cells, index + step) for step in (-1, 0, 1)], axis=0)))

    return hits


def _lookup(cells: NDArray[np.bool_], index: NDArray) -> NDArray[np.bool_]:
    inside = ((index >= 0) & (index < len(cells))).all(axis=1)
    return inside & cells[tuple(index.clip(0, len(cells) - 1).T)]
