# SPDX-License-Identifier: Apache-2.0
"""Where names go in a picture so that none covers another and all stay in it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

_RINGS, _DIRECTIONS = 40, 16
"""Places that are tried for a name: so many distances, in so many directions."""

_STEP = 0.6
"""From one distance to the next, heights of a name."""

_GAP = 2.0
"""Least distance between two names, pixels."""

_ON_A_MARK = 4.0
"""What it costs to cover a mark, heights of a name by which another place may be farther away."""


def place_labels(
    anchors: ArrayLike,
    sizes: ArrayLike,
    inside: tuple[float, float, float, float],
    marks: ArrayLike = (),
) -> NDArray[np.float64]:
    """Return the middle of each name, ``(M, 2)``, as near to what it names as there is room.

    The first names choose first. Where no place is free, a name stays where it is wanted, moved into the
    picture.

    Args:
        anchors: ``(M, 2)`` where the middle of each name is wanted, pixels.
        sizes: ``(M, 2)`` width and height of each name, pixels.
        inside: least x and y, and largest x and y, that a name may reach; pixels.
        marks: ``(n, 2)`` points better not covered, such as the middles of other things, pixels.
    """
    wanted, half = np.asarray(anchors, dtype=np.float64).reshape(-1, 2), np.asarray(sizes).reshape(-1, 2) / 2
    points = np.asarray(marks, dtype=np.float64).reshape(-1, 2)
    low, high = np.array(inside[:2]), np.array(inside[2:])
    turn = 2 * math.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    ways = np.concatenate([np.zeros((1, 2)), *(radius * ring for radius in range(1, _RINGS + 1))])
    placed = np.zeros((0, 2))
    for n, (anchor, reach) in enumerate(zip(wanted, half, strict=True)):
        step = _STEP * 2 * reach[1]
        # Names are wide: sideways the steps are longer.
        places = anchor + ways * step * (max(1.0, reach[0] / reach[1] / 2), 1.0)
        places = np.clip(places, low + reach, np.maximum(high - reach, low + reach))
        apart = np.abs(places[:, None] - placed) >= reach + half[:n] + _GAP
        free = apart.any(axis=2).all(axis=1)
        covered = (np.abs(places[:, None] - points) < reach + 1).all(axis=2).sum(axis=1)
        cost = np.linalg.norm(places - anchor, axis=1) + _ON_A_MARK * 2 * reach[1] * covered
        best = int(np.where(free, cost, np.inf).argmin()) if free.any() else 0
        placed = np.concatenate([placed, places[best : best + 1]])
    return placed
