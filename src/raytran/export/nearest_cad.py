# SPDX-License-Identifier: Apache-2.0
"""For each predicted object the CAD model of a library that is most like it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from raytran.classes import Classes
from raytran.data.shapenet.models import categories, model_names, read_facts, read_mesh, shapenet_version
from raytran.data.shapenet.voxelize import voxelize_solid
from raytran.data.targets import cad_meshes
from raytran.data.workers import work_on
from raytran.errors import DataError
from raytran.export.cad_alignments import align_cads
from raytran.structs import SHAPE_SIZE, CadAlignments, ObjectSet

_log = logging.getLogger(__name__)

_MODELS_PER_PROCESS = 200
"""Fewest models for which another process is worth its start."""

_OCCUPIED = 0.5

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class NearestCads:
    """The CAD models found.

    Attributes:
        objects: the ``M`` objects, with the names of their CAD models; "" where the library has none.
        box_center: ``(M, 3)`` float64 centre of each model's box, CAD units; NaN where there is none.
        box_half_size: ``(M, 3)`` float64 half its extents, CAD units; NaN where there is none.
        root: the library.
    """

    objects: ObjectSet
    box_center: Tensor
    box_half_size: Tensor
    root: Path

    def alignments(self) -> CadAlignments:
        """Return the poses of the models that were found, in the order of the objects."""
        index = self._found()
        names = [name.split("/") for name in self.objects.model_id if name]
        return align_cads(
            self.objects.select(index),
            [catid for catid, _ in names],
            [name for _, name in names],
            center=self.box_center[index],
            half_extent=self.box_half_size[index],
        )

    def meshes(self) -> list[trimesh.Trimesh | None]:
        """Return each object's CAD model, stretched into its box, in world coordinates, or None."""
        index = self._found()
        placed: list[trimesh.Trimesh | None] = [None] * len(self.objects)
        meshes = cad_meshes(self.objects.select(index), shapenet_root=self.root)
        for m, (vertices, faces) in zip(index.tolist(), meshes, strict=True):
            placed[m] = trimesh.Trimesh(vertices, faces, process=False)
        return placed

    def _found(self) -> Tensor:
        """Return where there is a model, int64."""
        return torch.tensor([m for m, name in enumerate(self.objects.model_id) if name], dtype=torch.int64)


def nearest_cads(objects: ObjectSet, root: Path, *, processes: int = 0, progress: bool = True) -> NearestCads:
    """Find the CAD model of each object's class that fits it best.

    The fit of a model is the IoU of both shape grids, each over its own box, times the IoU of both boxes
    brought to one diagonal and one centre: how alike they are once the model fills the object's box, and how
    little it is stretched for that. Objects without a shape are judged by the boxes alone. Models whose box
    alone rules them out are not read.

    Args:
        objects: ``M`` objects.
        root: folder of CAD models in ShapeNet's layout, as for ``raytran.data.shapenet.models.mesh_path``.
            Models that cannot be read are left out and counted.
        processes: worker processes, 0 for one per core.
        progress: show a progress bar for each class.

    Raises:
        DataError: ``root`` holds no CAD model.
    """
    shapenet_version(root)
    choices = [_NONE] * len(objects)
    left_out: dict[str, str] = {}
    for label in sorted(set(objects.label.tolist())):
        index = (objects.label == label).nonzero().squeeze(1)
        models, extents = _models_of_class(root, objects.classes, label, left_out)
        search = partial(
            work_on,
            label=f"CAD models: {objects.classes.names[label]}",
            processes=processes,
            items_each=_MODELS_PER_PROCESS,
            progress=progress,
        )
        best = _best_of_class(objects.select(index), root, models, extents, search, left_out)
        for m, choice in zip(index.tolist(), best, strict=True):
            choices[m] = choice
    _report(objects, choices, root, left_out)
    boxes = torch.from_numpy(np.array([choice.box for choice in choices]).reshape(-1, 2, 3))
    low, high = boxes[:, 0], boxes[:, 1]
    named = replace(objects, model_id=tuple(choice.name for choice in choices))
    return NearestCads(named, (low + high) / 2, (high - low) / 2, root)


class _Choice(NamedTuple):
    """A model's fit, its ``catid/id`` and the lower and upper corner of its box, CAD units, ``(2, 3)``."""

    fit: float
    name: str
    box: NDArray[np.float64]


_NONE = _Choice(0.0, "", np.full((2, 3), np.nan))


class _Cells(NamedTuple):
    """A model's rank in the order of the search, packed cells and box; without cells, the reason."""

    rank: int
    name: str
    cells: NDArray[np.uint8] | None
    box: NDArray[np.float64]
    reason: str


def _models_of_class(
    root: Path, classes: Classes, label: int, left_out: dict[str, str]
) -> tuple[list[str], Floats]:
    """Return the ``catid/id`` of a class's models and their extents ``(C, 3)``, in any unit."""
    names, extents = [], []
    for catid in categories(root):
        if classes.label_of(catid) != label:
            continue
        for name in model_names(root, catid):
            try:
                facts = read_facts(root, catid, name)
            except DataError as error:
                left_out[f"{catid}/{name}"] = str(error)
                continue
            if (facts.high > facts.low).all():
                names.append(f"{catid}/{name}")
                extents.append(facts.high - facts.low)
            else:
                left_out[f"{catid}/{name}"] = f"{catid}/{name} is flat and has no size to be stretched"
    return names, np.array(extents, dtype=np.float64).reshape(-1, 3)


def _best_of_class(
    objects: ObjectSet,
    root: Path,
    models: Sequence[str],
    extents: Floats,
    search: Callable[..., Iterator[_Cells]],
    left_out: dict[str, str],
) -> list[_Choice]:
    """Return the best of a class's models for each of its ``M`` objects.

    No fit exceeds the IoU of the boxes. Models are read in the order of the highest that they can reach,
    until none that remains can be better than the best so far.
    """
    best = [_NONE] * len(objects)
    if not models:
        return best
    reach = _box_iou(extents, objects.size.double().cpu().numpy())
    order = np.argsort(-reach.max(axis=1), kind="stable")
    reach = reach[order]
    # Row k: the most that a model from k on can reach, for each object.
    beyond = np.maximum.accumulate(reach[::-1], axis=0)[::-1]
    grids = torch.zeros(len(objects), 1, 1, 1) if objects.shape is None else objects.shape.cpu()
    side = SHAPE_SIZE if objects.shape is None else grids.shape[-1]
    shapes = (grids > _OCCUPIED).flatten(1).numpy().astype(np.float32)
    jobs = list(enumerate(models[i] for i in order))
    waiting = np.ones(len(jobs) + 1, dtype=bool)
    for result in search(jobs, partial(_read_cells, root, side)):
        waiting[result.rank] = False
        if result.cells is None:
            left_out[result.name] = result.reason
        else:
            fits = reach[result.rank] * _shape_iou(shapes, result.cells, side)
            for m, fit in enumerate(fits.tolist()):
                # Results come in any order; of equals the first by name is taken.
                if (fit, best[m].name) > (best[m].fit, result.name):
                    best[m] = _Choice(fit, result.name, result.box)
        first = int(waiting.argmax())
        if first < len(jobs) and (beyond[first] < [choice.fit for choice in best]).all():
            break
    return best


def _read_cells(root: Path, side: int, job: tuple[int, str]) -> _Cells:
    rank, name = job
    try:
        mesh = read_mesh(root, *name.split("/"))
    except DataError as error:
        return _Cells(rank, name, None, _NONE.box, str(error))
    # Only the vertices that faces use count, as in the annotation and in the shapes of training.
    used, faces = np.unique(mesh.faces, return_inverse=True)
    vertices = mesh.vertices[used]
    box = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    if not (box[1] > box[0]).all():
        return _Cells(rank, name, None, _NONE.box, f"{name} is flat and has no size to be stretched")
    cells = np.packbits(voxelize_solid(vertices, faces.reshape(-1, 3), size=side))
    return _Cells(rank, name, cells, box, "")


def _shape_iou(shapes: NDArray[np.float32], cells: NDArray[np.uint8], side: int) -> Floats:
    """Return the IoU of a model with each of ``(M, side³)`` shapes; 1 where a shape is empty."""
    if shapes.shape[1] != side**3:
        return np.ones(len(shapes))
    inside = np.unpackbits(cells, count=side**3).astype(np.float32)
    common, volume = shapes @ inside, shapes.sum(axis=1)
    iou: Floats = np.where(volume > 0, common / (volume + inside.sum() - common), 1.0)
    return iou


def _box_iou(first: Floats, second: Floats) -> Floats:
    """Return the IoU ``(A, B)`` of boxes of extents ``(A, 3)`` and ``(B, 3)``, brought to one diagonal."""
    one = first / np.linalg.norm(first, axis=1, keepdims=True)
    other = second / np.linalg.norm(second, axis=1, keepdims=True)
    common = np.minimum(one[:, None], other).prod(axis=2)
    iou: Floats = common / (one.prod(axis=1)[:, None] + other.prod(axis=1) - common)
    return iou


def _report(objects: ObjectSet, choices: Sequence[_Choice], root: Path, left_out: dict[str, str]) -> None:
    """Say for how many objects there is a model, and what was left out."""
    none = sorted({name for name, choice in zip(objects.category, choices, strict=True) if not choice.name})
    missing = f"; {root} has no CAD model of class {', '.join(none)}" if none else ""
    num_found = sum(bool(choice.name) for choice in choices)
    _log.info("nearest CAD models: for %d of %d objects%s", num_found, len(choices), missing)
    if left_out:
        _log.warning("left out %d CAD models, e.g. %s", len(left_out), next(iter(left_out.values())))
