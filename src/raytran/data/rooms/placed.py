# SPDX-License-Identifier: Apache-2.0
"""A CAD model that stands somewhere in a room, and the pool that models are drawn from."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from raytran.data.rooms.cad import CadModel, sample_model
from raytran.data.rooms.collision import Boxes
from raytran.types import CLASSES

MODELS_PER_CLASS = 100
"""Models of one class that the rooms of one seed share, as scans share the CAD models of Scan2CAD."""

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


@dataclass(frozen=True)
class ModelPool:
    """The CAD models that all rooms of one seed draw from.

    Attributes:
        seed: seed of the rooms.
    """

    seed: int

    def draw(
        self, category: str, rng: np.random.Generator, *, kinds: Collection[str] = ()
    ) -> CadModel | None:
        """Draw a model of a class, if ``kinds`` is not empty of one of these kinds; None if none is found."""
        for number in rng.integers(MODELS_PER_CLASS, size=60):
            model = _pool_model(self.seed, category, int(number))
            if not kinds or model.kind in kinds:
                return model
        return None


@lru_cache(maxsize=2048)
def _pool_model(seed: int, category: str, number: int) -> CadModel:
    # Scenes are seeded by two numbers, models by three: the streams never meet.
    return sample_model(category, np.random.default_rng([seed, CLASSES.index(category), number]))
