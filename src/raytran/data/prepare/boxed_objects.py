# SPDX-License-Identifier: Apache-2.0
"""Objects annotated by boxes: whether they can be right, and their form in Scan2CAD's annotation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.data.prepare.annotation import Entry
from raytran.data.prepare.boxed_mesh import Mesh
from raytran.errors import DataError
from raytran.geometry.boxes import OrientedBoxes
from raytran.geometry.boxes_in_view import boxes_in_view
from raytran.geometry.camera import Cameras
from raytran.geometry.rotation import quaternion_from_matrix
from raytran.limits import shown

SYMMETRIES = {1: "__SYM_NONE", 2: "__SYM_ROTATE_UP_2", 4: "__SYM_ROTATE_UP_4", 0: "__SYM_ROTATE_UP_INF"}
"""Equal turns about the up axis, 0 for a body of revolution → as Scan2CAD writes it."""

LARGEST_SIDE = 20.0
"""Metres; no object of a room has a longer side."""

FARTHEST = 200.0
"""Metres between a box and the cameras beyond which both are in different units."""

_UNITS = {"millimetres": 0.001, "centimetres": 0.01}


@dataclass(frozen=True)
class BoxedObjects:
    """The M annotated objects of one scan, in the world of its cameras.

    Attributes:
        named_in: the file that lists them, for messages.
        category: of each, the name of a class.
        center: ``(M, 3)`` float64, metres.
        size: ``(M, 3)`` full extents along the object's own axes (x width, y height, z depth).
        rotation: ``(M, 3, 3)`` world_from_object.
        symmetry: of each, equal turns about its up axis: 1, 2, 4, or 0 for any.
        mesh: its own mesh in the world, None if it has none.
        scan_mesh: of the whole scan in the world; None if there is none.
        own_meshes_first: whether objects' own meshes are better than the scan's.
        noticed: what is odd about some of them: a few words → details.
    """

    named_in: str
    category: tuple[str, ...]
    center: NDArray[np.float64]
    size: NDArray[np.float64]
    rotation: NDArray[np.float64]
    symmetry: tuple[int, ...]
    mesh: tuple[Mesh | None, ...]
    scan_mesh: Mesh | None = None
    own_meshes_first: bool = True
    noticed: dict[str, list[str]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.category)

    def name(self, index: int) -> str:
        """Return what to call an object in messages."""
        return f"object {index} ({self.category[index]})"

    def moved(self, world_from_input: torch.Tensor | None) -> BoxedObjects:
        """Return the objects in another world.

        Args:
            world_from_input: ``(4, 4)`` a rotation, scaled, and a shift; None: the same world.
        """
        if world_from_input is None:
            return self
        matrix = world_from_input.double().numpy()
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return replace(
            self,
            center=self.center @ matrix[:3, :3].T + matrix[:3, 3],
            size=self.size * scale,
            rotation=matrix[:3, :3] / scale @ self.rotation,
            mesh=tuple(None if mesh is None else moved_mesh(mesh, matrix) for mesh in self.mesh),
            scan_mesh=None if self.scan_mesh is None else moved_mesh(self.scan_mesh, matrix),
        )

    @property
    def boxes(self) -> OrientedBoxes:
        """The boxes alone."""
        return OrientedBoxes(*map(torch.from_numpy, (self.center, self.size, self.rotation)))


def moved_mesh(mesh: Mesh, matrix: NDArray[np.float64]) -> Mesh:
    """Return a mesh in another world, by ``(4, 4)``."""
    vertices, faces = mesh
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], faces


def check_boxes(objects: BoxedObjects, cameras: Cameras) -> BoxedObjects:
    """Return the objects, with those noticed that no camera sees, if they can be right.

    Args:
        objects: of a scan.
        cameras: of its N frames.

    Raises:
        DataError: they are in another unit, or in another world than the cameras; or one is far too large.
    """
    longest = objects.size.max(axis=1)
    _check_unit(objects, longest)
    too_long = np.flatnonzero(longest > LARGEST_SIDE)
    if len(too_long):
        index = int(too_long[0])
        raise DataError(
            f"{objects.name(index)} in {objects.named_in} is {longest[index]:.3g} m long, as nothing in a "
            "room is: mend its size, in metres"
        )
    distance = np.linalg.norm(objects.center - cameras.position.mean(dim=0).double().numpy(), axis=1)
    if float(np.median(distance)) > FARTHEST:
        raise DataError(
            f"the boxes in {objects.named_in} lie {float(np.median(distance)):.3g} m from the cameras: give "
            "their centres in metres, in the world of the poses"
        )
    is_seen = boxes_in_view(objects.boxes, cameras).numpy()
    if not is_seen.any():
        raise DataError(
            f"no camera sees any of the {len(objects)} boxes in {objects.named_in}: they are in another "
            "world than the poses, or their centres in another unit; annotate in the world of the poses"
        )
    unseen = [objects.name(i) for i in np.flatnonzero(~is_seen).tolist()]
    return replace(objects, noticed=objects.noticed | ({"objects_unseen": unseen} if unseen else {}))


def _check_unit(objects: BoxedObjects, longest: NDArray[np.float64]) -> None:
    """Raise if sizes are those of furniture in another unit."""
    median = float(np.median(longest))
    if median <= LARGEST_SIDE:
        return
    # Furniture is half a metre to three metres long.
    name = min(_UNITS, key=lambda unit: abs(np.log(median * _UNITS[unit])))
    raise DataError(
        f"the boxes in {objects.named_in} are {median:.4g} long in the median, so they are in {name}: write "
        f"metres (multiply sizes and centres by {_UNITS[name]:g})"
    )


def annotation_entry(objects: BoxedObjects, scene_id: str, model_ids: Sequence[str]) -> Entry:
    """Return the objects as an entry of ``full_annotations.json``.

    The world is that of the poses; each model's box is the cube [-½, ½]³, so that the scale is the size.

    Args:
        objects: M of them.
        scene_id: name of the scan.
        model_ids: ``category/name`` of the mesh of each, see ``models.BOXED``.
    """
    quaternions = quaternion_from_matrix(torch.from_numpy(objects.rotation)).tolist()
    models = [
        {
            "trs": _trs(objects.center[i].tolist(), quaternions[i], objects.size[i].tolist()),
            "center": [0.0, 0.0, 0.0],
            "bbox": [0.5, 0.5, 0.5],
            "sym": SYMMETRIES[objects.symmetry[i]],
            "catid_cad": model_id.partition("/")[0],
            "id_cad": model_id.partition("/")[2],
        }
        for i, model_id in enumerate(model_ids)
    ]
    world = _trs([0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0])
    return {"id_scan": scene_id, "trs": world, "n_aligned_models": len(models), "aligned_models": models}


def _trs(translation: list[float], rotation: list[float], scale: list[float]) -> dict[str, Any]:
    return {"translation": translation, "rotation": rotation, "scale": scale}


def as_symmetry(value: object, what: str) -> int:
    """Return a number of equal turns about the up axis.

    Raises:
        DataError: it is none that a network can be taught.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value not in SYMMETRIES:
        raise DataError(
            f"{what} is {shown(value)}: give 1, 2 or 4 equal turns, or 0 for a body of revolution"
        )
    return value
