# SPDX-License-Identifier: Apache-2.0
"""One scan whose objects are annotated by boxes: its frames, cameras and what stands in each box."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from raytran.data.cache import MaskCache
from raytran.data.files import finished_folder, write_json, write_text
from raytran.data.prepare.annotation import Entry
from raytran.data.prepare.boxed_mesh import Mesh, box_mesh, cut_to_box, share_in_box
from raytran.data.prepare.boxed_objects import BoxedObjects, annotation_entry, check_boxes
from raytran.data.prepare.scan import PrepareSettings, read_facts, scan_folder, write_scan
from raytran.data.prepare.targets import check_disk, write_masks
from raytran.data.scan import OpenScan
from raytran.data.scannet.scan import read_scan
from raytran.data.shapenet.models import BOX_MODEL, BOXED
from raytran.data.targets import shape_grids
from raytran.data.text import read_json_object
from raytran.errors import DataError

ENTRY = "annotation.json"
"""File in a prepared scan's folder with its part of ``full_annotations.json``."""

_MOSTLY = 0.9
"""Share of an object's own mesh that must lie in its box: of a box that was moved, the mesh is elsewhere."""

_UNFIT = re.compile(r"[^\w-]+")


class AnnotatedSource(Protocol):
    """A scan somewhere, in any form, with boxes of its objects; it can be sent to another process."""

    @property
    def scene_id(self) -> str:
        """Name of the prepared scan."""

    @property
    def form(self) -> str:
        """What it was recognised as, for the report."""

    @property
    def path(self) -> Path:
        """Its folder or file."""

    @property
    def split(self) -> str | None:
        """``train``, ``val`` or ``test``; None: it is chosen."""

    @property
    def state(self) -> str:
        """A digest of the annotation: a prepared scan is done as long as it stays."""

    def open(self) -> OpenScan:
        """Open the frames.

        Raises:
            DataError: they cannot be read.
        """

    def read_objects(self, scan: OpenScan) -> BoxedObjects:
        """Return the objects, in the world of the open scan.

        Raises:
            DataError: the annotation is damaged, or says what cannot be.
        """


@dataclass(frozen=True)
class FoundSources:
    """The scans below a folder.

    Attributes:
        sources: with boxes and frames, in the order of their names.
        without_boxes: names of scans without boxes.
        without_frames: annotations of scans without frames.
    """

    sources: tuple[AnnotatedSource, ...]
    without_boxes: tuple[str, ...]
    without_frames: tuple[str, ...]

    @property
    def left_out(self) -> Mapping[str, Any]:
        """What is not prepared, by the keys of the report."""
        return {
            "scans_without_boxes": list(self.without_boxes),
            "boxes_without_scan": list(self.without_frames),
        }


def scene_name(name: str) -> str:
    """Return a name of letters, digits, _ and - that can be that of a folder and of a file."""
    return _UNFIT.sub("_", name).strip("_") or "scan"


def is_prepared(source: AnnotatedSource, output: Path) -> bool:
    """Return whether a scan was prepared from the annotation as it is now."""
    folder = scan_folder(output, source.scene_id)
    return (folder / ENTRY).is_file() and read_facts(output, source.scene_id).get("state") == source.state


def prepare_boxed_scan(
    source: AnnotatedSource, output: Path, settings: PrepareSettings
) -> tuple[str, str | None]:
    """Prepare a scan unless that is done.

    Returns:
        the scan and, if it cannot be used, why.

    Raises:
        DataError: the disk of ``output`` is full or read-only.
    """
    try:
        if is_prepared(source, output):
            return source.scene_id, None
        with finished_folder(scan_folder(output, source.scene_id), replace=True) as folder:
            _write(source, folder, output, settings)
    except (DataError, OSError) as error:
        check_disk(error, output)
        return source.scene_id, str(error)
    return source.scene_id, None


def read_entry(output: Path, scene_id: str) -> Entry:
    """Return a prepared scan's part of the annotation.

    Raises:
        DataError: the file is missing or damaged.
    """
    return read_json_object(scan_folder(output, scene_id) / ENTRY)


def _write(source: AnnotatedSource, folder: Path, output: Path, settings: PrepareSettings) -> None:
    with source.open() as scan:
        objects = check_boxes(source.read_objects(scan), scan.cameras)
        models, noticed = _write_models(objects, source.scene_id, output)
        facts: dict[str, Any] = {"noticed": noticed, "split": source.split, "state": source.state}
        write_scan(scan, folder, settings, form=source.form, facts=facts)
    entry = annotation_entry(objects, source.scene_id, models)
    write_json(folder / ENTRY, entry)
    cache = MaskCache(folder=output / "cache")
    shape_grids(tuple(models), shapenet_root=output / "shapenet", cache=cache)
    if settings.masks:
        # As a data set sees the cameras: through the files.
        write_masks(entry, read_scan(folder).cameras, output)


def _write_models(
    objects: BoxedObjects, scene_id: str, output: Path
) -> tuple[list[str], dict[str, list[str]]]:
    """Write what stands in each box.

    Returns:
        ``category/name`` of each object's model, and what is odd about objects.
    """
    shapenet = output / "shapenet"
    for earlier in shapenet.glob(f"*/{scene_id}.*"):
        shutil.rmtree(earlier, ignore_errors=True)
    models: list[str] = []
    noticed = {what: list(names) for what, names in objects.noticed.items()}
    for index, category in enumerate(objects.category):
        mesh, is_elsewhere = _mesh_in_box(objects, index)
        if is_elsewhere:
            noticed.setdefault("meshes_outside_box", []).append(objects.name(index))
        if mesh is None:
            noticed.setdefault("objects_without_shape", []).append(objects.name(index))
        name = BOX_MODEL if mesh is None else f"{scene_id}.{index:03d}"
        path = shapenet / category / name / "models" / BOXED
        if mesh is not None or not path.is_file():
            write_text(path, obj_text(mesh or box_mesh()))
        models.append(f"{category}/{name}")
    return models, noticed


def _mesh_in_box(objects: BoxedObjects, index: int) -> tuple[Mesh | None, bool]:
    """Return the mesh of an object in its box, None if there is none, and whether its own lies elsewhere."""
    box = {name: getattr(objects, name)[index] for name in ("center", "size", "rotation")}
    own, is_elsewhere = objects.mesh[index], False
    if own is not None and share_in_box(own, **box) < _MOSTLY:
        own, is_elsewhere = None, True
    from_own = None if own is None else cut_to_box(own, **box, on_floor=False)
    if from_own is not None and objects.own_meshes_first:
        return from_own, is_elsewhere
    from_scan = None if objects.scan_mesh is None else cut_to_box(objects.scan_mesh, **box)
    return from_own if from_scan is None else from_scan, is_elsewhere


def obj_text(mesh: Mesh) -> str:
    """Return a mesh as an OBJ file."""
    vertices, faces = mesh
    lines: Sequence[str] = [f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices.tolist()]
    return "".join([*lines, *(f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist())])
