# SPDX-License-Identifier: Apache-2.0
"""Painted triangles: the form in which a room and its furniture reach the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

ROOM_OWNER = -1
"""Owner of triangles that belong to the room itself and to no object."""

_BOX_QUADS = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))


@dataclass(frozen=True)
class Paint:
    """How a surface looks: a grey texture blended between two colours.

    Attributes:
        dark: display RGB in [0, 1] where the texture is 0.
        light: display RGB in [0, 1] where the texture is 1.
        texture: index into ``materials.TEXTURES``.
        emissive: the surface shines and takes no light.
    """

    dark: tuple[float, float, float]
    light: tuple[float, float, float]
    texture: int = 0
    emissive: bool = False


@dataclass(frozen=True)
class Surfaces:
    """``T`` painted triangles in the room's frame, metres.

    Attributes:
        triangles: ``(T, 3, 3)`` float32 corners.
        dark: ``(T, 3)`` float32, as in ``Paint``.
        light: ``(T, 3)`` float32.
        texture: ``(T,)`` int32.
        emissive: ``(T,)`` bool.
        owner: ``(T,)`` int32 number of the object, or ``ROOM_OWNER``.
    """

    triangles: NDArray[np.float32]
    dark: NDArray[np.float32]
    light: NDArray[np.float32]
    texture: NDArray[np.int32]
    emissive: NDArray[np.bool_]
    owner: NDArray[np.int32]

    @staticmethod
    def painted(triangles: NDArray[np.floating], paint: Paint, owner: int = ROOM_OWNER) -> Surfaces:
        """Return ``(T, 3, 3)`` triangles that all have the same paint."""
        count = len(triangles)
        return Surfaces(
            triangles=np.asarray(triangles, dtype=np.float32),
            dark=np.tile(np.asarray(paint.dark, dtype=np.float32), (count, 1)),
            light=np.tile(np.asarray(paint.light, dtype=np.float32), (count, 1)),
            texture=np.full(count, paint.texture, dtype=np.int32),
            emissive=np.full(count, paint.emissive),
            owner=np.full(count, owner, dtype=np.int32),
        )

    @staticmethod
    def joined(parts: Sequence[Surfaces]) -> Surfaces:
        """Return the triangles of all ``parts``, in order."""
        return Surfaces(
            triangles=np.concatenate([part.triangles for part in parts]),
            dark=np.concatenate([part.dark for part in parts]),
            light=np.concatenate([part.light for part in parts]),
            texture=np.concatenate([part.texture for part in parts]),
            emissive=np.concatenate([part.emissive for part in parts]),
            owner=np.concatenate([part.owner for part in parts]),
        )


def box_triangles(lower: ArrayLike, upper: ArrayLike) -> NDArray[np.float64]:
    """Return the 12 triangles ``(12, 3, 3)`` of the axis-aligned box between two corners."""
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
    return np.concatenate([quad_triangles(corners[list(quad)]) for quad in _BOX_QUADS])


def quad_triangles(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return two triangles ``(2, 3, 3)`` that fill a flat quadrilateral ``(4, 3)`` given round its rim."""
    return corners[np.array([[0, 1, 2], [0, 2, 3]])]
