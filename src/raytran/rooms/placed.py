# SPDX-License-Identifier: Apache-2.0
"""A CAD model that stands somewhere in a room."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from raytran.rooms.cad import CadModel
from raytran.rooms.collision import Boxes

FLOOR = -1
"""Parent of an object that stands on the floor."""


@dataclass(frozen=True)
class PlacedObject:
    """An object in the room's frame: ``p = translation + rotation · (scale ∘ p_cad)``.

    Attributes:
        model: the CAD model.
        scale: ``(3,)`` metres per CAD unit along the object's axes.
        rotation: ``(3, 3)`` room_from_object, ``tilt · Rz(yaw) · B``.
        translation: ``(3,)`` position of the CAD origin, metres.
        tilt: ``(3, 3)`` the small turn away from upright.
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
