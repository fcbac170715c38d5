# SPDX-License-Identifier: Apache-2.0
"""How symmetric a mesh is about its up axis, measured: no released CAD model says so."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from raytran.types import SYMMETRY_INFINITE

_POINTS = 6000
_FAR = 0.02
"""A point of the turned surface farther than this from the surface, as a share of its size, is off it."""

_OFF = 0.02
"""Largest share of points off the surface that still passes as the same surface."""

_ROUND_TURNS = (360 / 7, 360 / 9, 360 / 11, 17.0)
"""Turns in degrees that map only a body of revolution onto itself, not a prism of a few sides."""


def measure_symmetry(vertices: ArrayLike, faces: ArrayLike) -> int:
    """Return the number of equal turns about +Y that map a mesh onto itself: 1, 2, 4, or 0 for every turn.

    The axis is the middle of the mesh's box. Points spread evenly over the surface are turned and compared
    with the surface as a dense set of points, in both directions; at most 2 % of them may lie farther from it
    than 2 % of the mesh's horizontal diagonal. Small details, such as a handle, so decide nothing. The same
    mesh always gives the same answer.

    Args:
        vertices: ``(V, 3)``, +Y up, any unit.
        faces: ``(F, 3)`` vertex indices.
    """
    corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces)]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    corners = corners - (low + high) / 2
    width, _, depth = high - low
    reach = _FAR * float(np.hypot(width, depth))
    if reach <= 0:
        return 1
    rng = np.random.default_rng(0)
    probe, dense = _spread(corners, _POINTS, rng), _spread(corners, 8 * _POINTS, rng)
    tree = cKDTree(dense)
    # Points of one surface lie apart too: what no turn at all leaves is no asymmetry.
    spacing = float(np.quantile(tree.query(probe)[0], 0.95))

    def same_after(degrees: float) -> bool:
        near = max(reach, 2 * spacing)
        return all(
            float((tree.query(_turned(probe, turn), distance_upper_bound=near)[0] > near).mean()) <= _OFF
            for turn in (degrees, -degrees)
        )

    square = abs(width - depth) <= 2 * _FAR * max(width, depth)
    if not same_after(180):
        return 1
    if not square or not same_after(90):
        return 2
    return SYMMETRY_INFINITE if all(same_after(turn) for turn in _ROUND_TURNS) else 4


def _spread(corners: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return ``(count, 3)`` points on triangles ``(F, 3, 3)``, as many per area everywhere."""
    edges = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).cumsum()
    # One point in each of ``count`` equal shares of the area: no clusters, no gaps.
    chosen = np.searchsorted(area, (np.arange(count) + rng.random(count)) / count * area[-1])
    chosen = chosen.clip(max=len(corners) - 1)
    a, b = rng.random((2, count, 1))
    flip = a + b > 1
    a, b = np.where(flip, 1 - a, a), np.where(flip, 1 - b, b)
    points: NDArray[np.float64] = corners[chosen, 0] + a * edges[chosen, 0] + b * edges[chosen, 1]
    return points


def _turned(points: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    sin, cos = np.sin(np.deg2rad(degrees)), np.cos(np.deg2rad(degrees))
    x, y, z = points.T
    return np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=1)
