# SPDX-License-Identifier: Apache-2.0
"""Objects that stand in a room, their boxes, and which boxes overlap.

``raytran.geometry.boxes`` is not used for the overlap: it computes the volume that boxes share, which takes
ten times as long for the thousands of positions that are tried in a room.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from raytran.rooms.cad import CadModel

FLOOR = -1
"""Parent of an object that stands on the floor."""


_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)


@dataclass(frozen=True)
class Boxes:
    """``n`` oriented boxes.

    Attributes:
        center: ``(n, 3)`` metres.
        axes: ``(n, 3, 3)``; the columns are the unit axes.
        half: ``(n, 3)`` half extents along the axes, metres.
    """

    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    half: NDArray[np.float64]

    @staticmethod
    def aligned(bounds: NDArray[np.float64]) -> Boxes:
        """Return the boxes of axis-aligned bounds ``(n, 2, 3)`` (lower, upper)."""
        lower, upper = bounds[:, 0], bounds[:, 1]
        return Boxes((lower + upper) / 2, np.tile(np.eye(3), (len(bounds), 1, 1)), (upper - lower) / 2)

    @staticmethod
    def joined(sets: list[Boxes]) -> Boxes:
        """Return the boxes of several sets as one set, in order."""
        return Boxes(
            np.concatenate([boxes.center for boxes in sets]),
            np.concatenate([boxes.axes for boxes in sets]),
            np.concatenate([boxes.half for boxes in sets]),
        )

    def __len__(self) -> int:
        return len(self.center)

    def grown(self, margin: float) -> Boxes:
        """Return the boxes with every side pushed outwards by ``margin`` metres."""
        return Boxes(self.center, self.axes, self.half + margin)

    def corners(self) -> NDArray[np.float64]:
        """Return ``(n, 8, 3)``."""
        return self.center[:, None] + np.einsum("nij,nkj->nki", self.axes, _SIGNS * self.half[:, None])

    def contain(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether each of the points ``(m, 3)`` is inside each box, ``(m, n)`` bool."""
        local = np.einsum("mni,nij->mnj", points[:, None] - self.center, self.axes)
        return (np.abs(local) <= self.half).all(axis=-1)


def overlaps(box: Boxes, others: Boxes) -> NDArray[np.bool_]:
    """Return whether the single ``box`` shares volume with each of ``others``, ``(n,)`` bool.

    The separating-axis test over the 3 + 3 face normals and the 9 products of edges (Gottschalk et al. 1996).
    """
    # Everything is expressed in the frame of ``box``: rotations (n, 3, 3) and offsets (n, 3) of the others.
    rotation = np.einsum("ji,njk->nik", box.axes[0], others.axes)
    offset = (others.center - box.center[0]) @ box.axes[0]
    # The small number covers edges that are parallel, whose product is no axis.
    absolute = np.abs(rotation) + 1e-9
    a, b = box.half[0], others.half
    apart = (np.abs(offset) > a + np.einsum("nij,nj->ni", absolute, b)).any(axis=1)
    in_other = np.einsum("ni,nij->nj", offset, rotation)
    apart |= (np.abs(in_other) > np.einsum("i,nij->nj", a, absolute) + b).any(axis=1)
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            reach_a = a[i1] * absolute[:, i2, j] + a[i2] * absolute[:, i1, j]
            reach_b = b[:, j1] * absolute[:, i, j2] + b[:, j2] * absolute[:, i, j1]
            distance = np.abs(offset[:, i2] * rotation[:, i1, j] - offset[:, i1] * rotation[:, i2, j])
            apart |= distance > reach_a + reach_b
    return ~apart


@dataclass(frozen=True)
class PlacedObject:
    """An object in the room's frame: ``p = translation + rotation · (scale ∘ p_cad)``.

    Attributes:
        model: the CAD model.
        scale: ``(3,)`` metres per CAD unit along the object's axes.
        rotation: ``(3, 3)`` room_from_object, ``tilt · Rz(yaw) · B``.
        translation: ``(3,)`` position of the CAD origin, metres.
        tilt: ``(3, 3)`` the small rotation away from upright.
        parent: number of the object it stands on, or ``FLOOR``.
    """

    model: CadModel
    scale: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    tilt: NDArray[np.float64]
    parent: int = FLOOR

    @cached_property
    def cad_box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centre and half extents ``(3,)`` each, CAD units, over the vertices that faces use."""
        return cad_box(self.model)

    @cached_property
    def box(self) -> Boxes:
        """The object's box, as a set of one."""
        center, half = self.cad_box
        middle = self.translation + self.rotation @ (self.scale * center)
        return Boxes(middle[None], self.rotation[None], (self.scale * half)[None])

    def triangles(self) -> NDArray[np.float64]:
        """Return ``(F, 3, 3)`` corners in the room's frame, metres."""
        scaled = self.model.vertices * self.scale
        # Sums instead of a matrix product: the bits then do not depend on the number of threads of BLAS.
        turned = sum((scaled[:, i, None] * self.rotation[:, i] for i in range(3)), np.zeros(3))
        return (turned + self.translation)[self.model.faces]


def cad_box(model: CadModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centre and half extents, ``(3,)`` each, of the vertices that faces use, in CAD units."""
    used = model.vertices[np.unique(model.faces)]
    lower, upper = used.min(axis=0), used.max(axis=0)
    return (lower + upper) / 2, (upper - lower) / 2


def upright_rotation(yaw: float) -> NDArray[np.float64]:
    """Return ``Rz(yaw) · B`` ``(3, 3)`` (see ``raytran.geometry.rotation``)."""
    sin, cos = np.sin(yaw), np.cos(yaw)
    return np.array([[cos, 0.0, sin], [sin, 0.0, -cos], [0.0, 1.0, 0.0]])


def yaw_facing(direction: NDArray[np.float64]) -> float:
    """Return the yaw at which an object's front (-Z) looks along a horizontal ``direction`` ``(2,)``."""
    return float(np.arctan2(-direction[0], direction[1]))
