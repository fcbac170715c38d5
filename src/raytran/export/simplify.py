# SPDX-License-Identifier: Apache-2.0
"""Meshes with few triangles that lie within a set distance of the ones they stand for."""

from __future__ import annotations

from typing import Any

import fast_simplification
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import KDTree

from raytran.setting_limits import check_settings

MESH_ERROR = 0.01
"""Farthest that a written mesh may lie from the surface of its object's shape, metres."""

_SMOOTHED = 0.5
"""Share of the distance that smoothing may take; the rest is left to fewer triangles."""

_PASSES, _SHRINK, _SWELL = 10, 0.5, -0.53
"""Of Taubin's smoothing (A signal processing approach to fair surface design, SIGGRAPH 1995, section 3)."""

_COARSENESS = (4.8, 4.8, 4.8, 4.8, 4.2)
"""Aggressiveness of each attempt, in units of the distance: 0.3 less leaves half of the error."""

_PROTECTED = 0.7
"""Vertices farther off than this share of the distance keep their triangles in the next attempt."""

_SPACING = 1.5
"""Between points on a simplified mesh, in units of the distance."""

_MOST_POINTS = 500_000
"""On one mesh; on a larger one they lie less densely."""

_NEAREST = 32
"""Triangles among which the nearest to a point is looked for; one that is missed makes it seem farther."""

_Floats = NDArray[np.float64]
_Faces = NDArray[np.int32]
_Mask = NDArray[np.bool_]


def simplify(mesh: trimesh.Trimesh, error: float = MESH_ERROR) -> trimesh.Trimesh:
    """Return a mesh with fewer triangles, smoother where the surface is rough by less than the distance.

    Taubin's smoothing takes the steps and ripples of a shape grid away, each vertex moving by at most half of
    the distance. Then edges collapse by quadric errors (Garland and Heckbert, SIGGRAPH 1997), and the result
    is measured. Quadrics do not see everything that is lost, such as the tip of a needle that moves along the
    needle: around vertices that come to lie too far away the triangles are kept, and the rest is tried again.

    Args:
        mesh: a surface without vertices that belong to no triangle.
        error: no vertex of ``mesh`` lies farther from the result, and no point of a dense sample of the
            result farther from ``mesh``, metres; 0 returns the mesh as it is.

    Raises:
        ConfigError: ``error`` is no distance.
    """
    check_settings({"mesh_error": error})
    if not error or not len(mesh.faces):
        return mesh
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int32)
    # In units of the distance, round the middle: thresholds are plain numbers, and no digits are lost.
    middle = vertices.mean(axis=0)
    exact = (vertices - middle) / error
    smooth = _smoothed(exact, faces, _SMOOTHED)
    protected = np.zeros(len(exact), dtype=bool)
    for coarseness in _COARSENESS:
        kept = _around(faces, protected)
        points, triangles = _collapsed(smooth, faces, kept, coarseness)
        away, added = _compare(exact, faces, points, triangles)
        if (away <= 1).all() and not added.any():
            break
        protected |= (away > _PROTECTED) | added
    else:
        # Smoothed alone it is near enough by construction.
        points, triangles = smooth, faces
    return trimesh.Trimesh(points * error + middle, triangles, process=False)


def _smoothed(vertices: _Floats, faces: _Faces, reach: float) -> _Floats:
    """Return vertices that have moved by at most ``reach`` towards a smooth surface that does not shrink."""
    start, stop = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    ends = np.concatenate([start, stop]), np.concatenate([stop, start])
    count = len(vertices)
    joined = sparse.csr_matrix((np.ones(len(ends[0])), ends), shape=(count, count))
    joined.data[:] = 1.0
    mean_of_neighbors = sparse.diags(1 / np.asarray(joined.sum(axis=1)).ravel()) @ joined
    moved = vertices
    for _ in range(_PASSES):
        for step in (_SHRINK, _SWELL):
            moved = moved + step * (mean_of_neighbors @ moved - moved)
    way = moved - vertices
    length = np.linalg.norm(way, axis=1, keepdims=True)
    return vertices + way * np.minimum(1.0, reach / np.maximum(length, 1e-12))


def _around(faces: _Faces, vertices: _Mask) -> _Mask:
    """Return the triangles at the given vertices, and those between them."""
    near = vertices.copy()
    near[faces[vertices[faces].any(axis=1)].ravel()] = True
    return np.asarray(near[faces].all(axis=1))


def _collapsed(vertices: _Floats, faces: _Faces, kept: _Mask, coarseness: float) -> tuple[_Floats, _Faces]:
    """Return the mesh with as many edges collapsed as its errors allow, but none of the triangles kept."""
    if kept.all():
        return vertices, faces
    points, triangles = fast_simplification.simplify(
        vertices, faces[~kept], target_count=1, agg=coarseness, preserve_border=bool(kept.any())
    )
    return _join(points, triangles, vertices, faces[kept])


def _join(points: _Floats, triangles: _Faces, vertices: _Floats, faces: _Faces) -> tuple[_Floats, _Faces]:
    """Return a mesh and some triangles of another in one; points of both are one."""
    used, renamed = np.unique(faces, return_inverse=True)
    both = np.concatenate([points, vertices[used]])
    whole = np.concatenate([triangles, renamed.reshape(-1, 3) + len(points)])
    # A border that was to stay has stayed to the last bit.
    merged, one = np.unique(both, axis=0, return_inverse=True)
    whole = one.reshape(-1)[whole]
    return merged, whole[(whole != np.roll(whole, 1, axis=1)).all(axis=1)].astype(np.int32)


def _compare(exact: _Floats, faces: _Faces, points: _Floats, triangles: _Faces) -> tuple[_Floats, _Mask]:
    """Return how far each vertex of a mesh is from another, and which lie where that one is too far away."""
    added = np.zeros(len(exact), dtype=bool)
    if not len(triangles):
        return np.full(len(exact), np.inf), added
    samples, owner = _samples(points[triangles])
    away = _distance(exact, samples, owner, points, triangles)
    centers = exact[faces].mean(axis=1)
    too_far = _distance(samples, centers, np.arange(len(faces)), exact, faces) > 1
    if too_far.any():
        added[KDTree(exact).query(samples[too_far])[1]] = True
    return away, added


def _samples(triangles: _Floats) -> tuple[_Floats, NDArray[np.int64]]:
    """Return points all over triangles ``(F, 3, 3)``, and the triangle of each."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = np.linalg.norm(np.cross(first, second), axis=1) / 2
    of_each = max(_SPACING**2, float(area.sum()) / _MOST_POINTS)
    owner = np.repeat(np.arange(len(triangles)), np.ceil(area / of_each).astype(int).clip(1))
    share = np.random.default_rng(0).random((len(owner), 2))
    share = np.where(share.sum(axis=1, keepdims=True) > 1, 1 - share, share)
    return triangles[owner, 0] + share[:, :1] * first[owner] + share[:, 1:] * second[owner], owner


def _distance(
    points: _Floats, places: _Floats, owner: NDArray[np.int64], vertices: _Floats, faces: NDArray[Any]
) -> _Floats:
    """Return how far points ``(n, 3)`` are from a mesh, of which places ``(m, 3)`` and their faces are known.

    What is within the share protected is not measured closer: it is the distance from the nearest place.
    """
    of_vertex = np.zeros(len(vertices), dtype=np.int64)
    of_vertex[faces] = np.arange(len(faces))[:, None]
    triangles = vertices[faces][np.concatenate([owner, of_vertex])]
    places = np.concatenate([places, vertices])
    tree = KDTree(places)
    away, _ = tree.query(points)
    rest = np.flatnonzero(away > _PROTECTED)
    count = min(_NEAREST, len(places))
    _, near = tree.query(points[rest], k=range(1, count + 1))
    for column in near.T:
        on_it = trimesh.triangles.closest_point(triangles[column], points[rest])
        away[rest] = np.minimum(away[rest], np.linalg.norm(on_it - points[rest], axis=1))
    return np.asarray(away)
